"""Calibration of the moving laser plane from its stripes on boards of known pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from echolume_messages import geometry
from echolume_messages.calibration import LaserCalibration
from echolume_messages.errors import CalibrationRejectedError
from echolume_messages.geometry import Matrix, Points3, require_shape
from echolume_processing.optical.board import Pattern
from echolume_processing.optical.camera import Camera
from echolume_processing.optical.plane_fit import grouped_covariance, robust_fit
from echolume_processing.optical.stripe import Stripe

Values = NDArray[np.float64]

EDGE_X_MM = 1.5
EDGE_Y_MM = 1.0
"""The print's brightness changes at the grid lines and would pull the stripe: nearer points are left out."""
MAX_SIGMA_PX = 0.2
MIN_POINTS = 20
"""Fewer points of a stripe on a board count as none."""
FIELD_MM = 100.0
FIELD_HEIGHT_MM = 40.0
MAX_FIELD_SIGMA_MM = 0.15
MAX_RMS_MM = 0.3
FLOOR_MM = 0.005
"""Least error that the points of a stripe are taken to share."""
MIN_BOARDS = 3
MAX_LEFT_OUT_MM = 0.3


@dataclass(frozen=True)
class StripeOnBoard:
    """Points (n, 3) of one stripe on one board, rig frame, with the guide's position at the exposure."""

    board: str
    x_mm: float
    points_mm: Points3


@dataclass(frozen=True)
class LaserFit:
    """The fitted plane and how far to trust it.

    Attributes
    ----------
    calibration : LaserCalibration
        n.X = offset_mm + s (n.g), with its covariance. Stripes tell only n.g of the guide's direction, so g is given
        along n.
    left_out_mm : dict
        Distance of each board's stripes from the plane fitted to the other boards; empty with fewer than three boards.
    field_sigma_mm : float
        Largest predicted sigma of the plane's position within the field.
    shared_mm : float
        Standard deviation of the error that the points of one stripe share.
    stripes, points : int
        How many were used.
    """

    calibration: LaserCalibration
    left_out_mm: dict[str, float]
    field_sigma_mm: float
    shared_mm: float
    stripes: int
    points: int

    @property
    def leave_one_out_mm(self) -> float:
        """RMS of `left_out_mm`; nan where that is empty."""
        return float(np.sqrt(np.mean(np.square(list(self.left_out_mm.values()))))) if self.left_out_mm else float("nan")


def stripe_on_board(camera: Camera, found: Stripe, rig_from_board: Matrix, board: Pattern) -> Points3:
    """Points (n, 3) in the rig frame where a camera sees the stripe on the print of a board of known pose.

    Parameters
    ----------
    camera : Camera
        With its pose in the rig frame.
    found : Stripe
        The stripe in its image; the strongest candidate of each row is taken.
    rig_from_board : (4, 4)
        Pose of the board.
    board : Pattern
        Its print: points off the print or near a grid line are left out.
    """
    rows = np.nonzero(found.sigma_px[:, 0] < MAX_SIGMA_PX)[0]
    pixels = camera.undistort(np.column_stack([found.column_px[rows, 0], rows.astype(np.float64)]))
    normal = rig_from_board[:3, 2]
    rays, centre = camera.rays(pixels), camera.centre_mm
    depth = (normal @ (rig_from_board[:3, 3] - centre)) / (rays @ normal)  # (n,)
    points = centre + depth[:, None] * rays
    local = geometry.apply(geometry.invert(rig_from_board), points) / board.square_mm  # in squares
    good = np.ones(len(points), dtype=np.bool_)
    for axis, count, edge_mm in ((0, board.columns, EDGE_X_MM), (1, board.rows, EDGE_Y_MM)):
        good &= (local[:, axis] > -0.9) & (local[:, axis] < count - 0.1)
        good &= np.abs(local[:, axis] - np.rint(local[:, axis])) * board.square_mm > edge_mm
    return points[good]


def fit_laser(stripes: Sequence[StripeOnBoard]) -> LaserFit:
    """Fit the laser plane that moves with the guide: n.X = offset + s (n.g).

    Parameters
    ----------
    stripes : sequence of StripeOnBoard
        Several guide positions on boards of several heights and tilts.

    Returns
    -------
    LaserFit

    Raises
    ------
    CalibrationRejectedError
        If the poses leave a direction of the plane open, the points do not lie on any such plane, or a board's do
        not lie on the plane found without it.

    Notes
    -----
    Robust (Huber, then a cut at five sigmas) linear least squares of x over guide position, y and z; its residual is
    the distance from the plane times a constant. The plane x = d of the paper's eq. 3 is the case n = g = (1, 0, 0).

    References
    ----------
    Llata et al., 2.1 and 2.2.2.
    """
    used = [s for s in stripes if len(s.points_mm) >= MIN_POINTS]
    for s in used:
        require_shape("points_mm", s.points_mm, (None, 3))
    if len(used) < 4:
        raise CalibrationRejectedError(
            f"calibrate laser: {len(used)} of {len(stripes)} stripes have {MIN_POINTS} points on a board, needs 4: "
            "check the exposure, and that the line meets the board"
        )
    points, x_mm = _stacked(used)
    design = _design(points, x_mm)
    _require_spread(design)
    fit = robust_fit(design, points[:, 0])
    beta = fit.beta
    normal_x = 1.0 / float(np.sqrt(1 + beta[2] ** 2 + beta[3] ** 2))
    kept = fit.weights > 0
    residual_mm = (points[:, 0] - design @ beta)[kept] * normal_x
    rms_mm = float(np.sqrt(np.mean(residual_mm**2)))
    ends = np.cumsum([0, *(len(s.points_mm) for s in used)])
    groups = [slice(int(a), int(b)) for a, b in pairwise(ends)]
    of_x, shared_mm = grouped_covariance(fit, design, points[:, 0], groups, FLOOR_MM)
    covariance = of_x * normal_x**2
    field_sigma_mm = _field_sigma(covariance)
    if rms_mm > MAX_RMS_MM:
        raise CalibrationRejectedError(
            f"calibrate laser: points lie {rms_mm:.2f} mm from the best plane, at most {MAX_RMS_MM} mm is accepted: "
            "did the board or the head move, or are guide positions and frames out of step?"
        )
    if field_sigma_mm > MAX_FIELD_SIGMA_MM:
        raise CalibrationRejectedError(
            f"calibrate laser: the poses determine the plane to {field_sigma_mm:.2f} mm only, "
            f"{MAX_FIELD_SIGMA_MM} mm is needed: add boards at other heights and tilts, "
            "and guide positions further apart"
        )
    per_guide = float(beta[1]) * normal_x
    if not 0.3 < abs(per_guide) < 1.2:
        raise CalibrationRejectedError(
            f"calibrate laser: the plane moves {per_guide:.3f} mm per mm of the guide, expected about 1: "
            "check the guide's steps per mm and that the board's x lies along the guide"
        )
    normal = np.array([1.0, -beta[2], -beta[3]]) * normal_x
    guide = per_guide * normal
    calibration = LaserCalibration(
        normal=(float(normal[0]), float(normal[1]), float(normal[2])),
        offset_mm=float(beta[0]) * normal_x,
        guide_direction=(float(guide[0]), float(guide[1]), float(guide[2])),
        rms_mm=rms_mm,
        plane_covariance=covariance.tolist(),
    )
    left_out_mm = _leave_one_out(used)
    _require_accepted(left_out_mm)
    return LaserFit(calibration, left_out_mm, field_sigma_mm, shared_mm, len(used), int(kept.sum()))


def _require_accepted(left_out_mm: dict[str, float]) -> None:
    """Refuse a plane that does not hold for a board it was not fitted to."""
    worst = max(left_out_mm, key=left_out_mm.__getitem__, default=None)
    if worst is not None and left_out_mm[worst] > MAX_LEFT_OUT_MM:
        raise CalibrationRejectedError(
            f"calibrate laser: rejected: the stripes on board {worst} lie {left_out_mm[worst]:.3f} mm from the plane "
            f"found without it, at most {MAX_LEFT_OUT_MM} mm is accepted: did that board move between its image and "
            "its stripes, or are the other boards too much alike?"
        )


def _design(points: Points3, x_mm: Values) -> Values:
    """Rows (1, s, y, z) of x = a + b s + c y + e z."""
    return np.column_stack([np.ones(len(points)), x_mm, points[:, 1], points[:, 2]])


def _require_spread(design: Values) -> None:
    """Refuse data in which the guide, y or z hardly varies on its own."""
    wanted = (
        (1, "guide position", 10.0, "take stripes at guide positions further apart"),
        (2, "place along the line (y)", 10.0, "let the line cross the whole board"),
        (3, "height (z)", 3.0, "put the board at other heights and tilts"),
    )
    for column, name, least_mm, advice in wanted:
        others = np.delete(design, column, axis=1)
        value = design[:, column]
        left = value - others @ np.linalg.lstsq(others, value, rcond=None)[0]
        spread_mm = float(np.sqrt(np.mean(left**2)))
        if spread_mm < least_mm:
            raise CalibrationRejectedError(
                f"calibrate laser: the {name} varies by only {spread_mm:.2f} mm on its own, {least_mm} mm is needed, "
                f"so the plane is not determined: {advice}"
            )


def _field_sigma(covariance: Values) -> float:
    """Largest predicted sigma of the plane's position within the field."""
    corners = np.array(
        [(1.0, s, y, z) for s in (-FIELD_MM, FIELD_MM) for y in (-FIELD_MM, FIELD_MM) for z in (0.0, FIELD_HEIGHT_MM)]
    )
    return float(np.sqrt(np.max(np.einsum("ij,jk,ik->i", corners, covariance, corners))))


def _leave_one_out(stripes: Sequence[StripeOnBoard]) -> dict[str, float]:
    """RMS over a board's stripes of their median distance from the plane fitted to the other boards, by board."""
    names = sorted({s.board for s in stripes})
    left_out: dict[str, float] = {}
    if len(names) < MIN_BOARDS:
        return left_out
    for name in names:
        points, x_mm = _stacked([s for s in stripes if s.board != name])
        beta = robust_fit(_design(points, x_mm), points[:, 0]).beta
        scale = 1.0 / float(np.sqrt(1 + beta[2] ** 2 + beta[3] ** 2))
        off_mm = [
            float(np.median(s.points_mm[:, 0] - _design(s.points_mm, np.full(len(s.points_mm), s.x_mm)) @ beta))
            for s in stripes
            if s.board == name
        ]
        left_out[name] = scale * float(np.sqrt(np.mean(np.square(off_mm))))
    return left_out


def _stacked(stripes: Sequence[StripeOnBoard]) -> tuple[Points3, Values]:
    """Points (n, 3) of all stripes, and the guide's position (n,) at each."""
    points = np.concatenate([s.points_mm for s in stripes])
    return points, np.concatenate([np.full(len(s.points_mm), s.x_mm) for s in stripes])
