"""Robot poses that determine the array's calibration, as a plan lists them (mm and degrees)."""

from __future__ import annotations

from echolume_messages.plan import Pose6

REFERENCE_HEIGHT_MM = 150.0


def plate_poses() -> list[Pose6]:
    """Poses over the bare bench: the reference four times, heights, places, tilts about both axes, and yaw.

    Low poses separate the channels' common delay from the height; far-apart places find the robot's tilt; tilts and
    yaw find the array on the flange.
    """
    reference = [(0.0, 0.0, REFERENCE_HEIGHT_MM, 0.0, 0.0, 0.0)] * 4
    heights = [(0.0, 0.0, z, 0.0, 0.0, 0.0) for z in (70.0, 70.0, 80.0, 100.0, 250.0)]
    places = [(x, y, REFERENCE_HEIGHT_MM, 0.0, 0.0, 0.0) for x in (-90.0, 90.0) for y in (-90.0, 90.0)]
    tilts = [
        (x, y, z, rx, ry, 0.0)
        for x, y, z, angle in ((30.0, 20.0, 120.0, 18.0), (-40.0, 30.0, 150.0, 18.0), (10.0, -40.0, 190.0, 12.0))
        for rx, ry in ((angle, 0.0), (-angle, 0.0), (0.0, angle), (0.0, -angle))
    ]
    turned = [
        (-20.0, -20.0, 130.0, 8.0, 8.0, 45.0),
        (20.0, -20.0, 130.0, -8.0, 8.0, -45.0),
        (0.0, 20.0, 130.0, 0.0, 0.0, 90.0),
    ]
    return [*reference, *heights, *places, *tilts, *turned]


def block_poses(
    x_mm: tuple[float, float] = (-32.0, 48.0),
    y_mm: tuple[float, float] = (-26.0, 38.0),
    pitch_mm: float = 10.0,
    height_mm: float = 110.0,
) -> list[Pose6]:
    """A boustrophedon raster across all four edges of the calibration block."""
    out: list[Pose6] = []
    rows = int((y_mm[1] - y_mm[0]) / pitch_mm + 1e-9) + 1
    columns = int((x_mm[1] - x_mm[0]) / pitch_mm + 1e-9) + 1
    for j in range(rows):
        order = range(columns) if j % 2 == 0 else range(columns - 1, -1, -1)
        out.extend((x_mm[0] + i * pitch_mm, y_mm[0] + j * pitch_mm, height_mm, 0.0, 0.0, 0.0) for i in order)
    return out
