"""Contact points from one emitter and N receivers: closed-form plane and point models, tested against each other.

All lengths are in mm, in a frame with the emitter at its origin and the receivers in the plane z = 0, z towards the
scene. A path is emitter -> surface -> receiver.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import Points3, require_shape
from echolume_messages.types import EchoKind

MIN_CHANNELS = 4
SLIP_MM = 1.5
"""A channel that lies this far from what all others agree on has slipped a cycle or seen another echo."""


@dataclass(frozen=True)
class Plane:
    """A plane as the image of the emitter in it: foot of the perpendicular = image / 2."""

    image_mm: NDArray[np.float64]
    paths_mm: NDArray[np.float64]
    """What the model predicts for each receiver, (receivers,)."""

    @property
    def distance_mm(self) -> float:
        """Distance from the emitter."""
        return 0.5 * float(np.linalg.norm(self.image_mm))

    @property
    def normal(self) -> NDArray[np.float64]:
        """Unit normal towards the array, (3,)."""
        return -self.image_mm / np.linalg.norm(self.image_mm)


@dataclass(frozen=True)
class Contact:
    """What one ping says: model, contact point of each used receiver, and how well they agree."""

    kind: EchoKind
    points_mm: Points3
    normals: Points3
    used: NDArray[np.bool_]
    """Receivers that the contact rests on, (receivers,)."""
    chi_squared: float
    """Per degree of freedom."""


@lru_cache(maxsize=1024)
def _inverse(receivers: bytes, used: bytes) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pseudo-inverses of the plane's rows (-2x, -2y, 1) and constant columns of the point's (2x, 2y)."""
    positions = np.frombuffer(receivers, dtype=np.float64).reshape(-1, 3)[np.frombuffer(used, dtype=np.bool_)]
    rows = np.column_stack([-2 * positions[:, 0], -2 * positions[:, 1], np.ones(len(positions))])
    return np.asarray(np.linalg.pinv(rows), dtype=np.float64), 2 * positions[:, :2]


def fit_plane(receivers_mm: Points3, paths_mm: NDArray[np.float64], used: NDArray[np.bool_]) -> Plane | None:
    """Plane from path lengths in closed form; None where no plane has such paths.

    L_i^2 - |r_i|^2 = -2 r_i . E' + |E'|^2 is linear in E'x, E'y and |E'|^2, E' being the emitter's mirror image.
    """
    inverse, _ = _inverse(receivers_mm.tobytes(), used.tobytes())
    squares = np.sum(receivers_mm**2, axis=1)
    x, y, square = (float(v) for v in inverse @ (paths_mm[used] ** 2 - squares[used]))
    depth = square - x * x - y * y
    if not depth > 0:
        return None
    image = np.array([x, y, np.sqrt(depth)])
    return Plane(image, np.linalg.norm(receivers_mm - image, axis=1))


def fit_point(
    receivers_mm: Points3, paths_mm: NDArray[np.float64], used: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Point target (3,) from path lengths in closed form, and the paths (receivers,) it predicts.

    2 r_i . P - 2 L_i R = |r_i|^2 - L_i^2 is linear in Px, Py and R = |P|.
    """
    _, columns = _inverse(receivers_mm.tobytes(), used.tobytes())
    lengths = paths_mm[used]
    rows = np.column_stack([columns, -2 * lengths])
    right = np.sum(receivers_mm[used] ** 2, axis=1) - lengths**2
    try:
        x, y, distance = (float(v) for v in np.linalg.solve(rows.T @ rows, rows.T @ right))
    except np.linalg.LinAlgError:
        return None
    depth = distance * distance - x * x - y * y
    if not (depth > 0 and distance > 0):
        return None
    point = np.array([x, y, np.sqrt(depth)])
    return point, distance + np.linalg.norm(receivers_mm - point, axis=1)


def _chi_squared(
    paths_mm: NDArray[np.float64],
    predicted_mm: NDArray[np.float64],
    sigma_mm: NDArray[np.float64],
    used: NDArray[np.bool_],
) -> float:
    freedom = int(np.count_nonzero(used)) - 3
    return float(np.sum(((paths_mm - predicted_mm)[used] / sigma_mm[used]) ** 2)) / max(freedom, 1)


def without_slips(
    receivers_mm: Points3, paths_mm: NDArray[np.float64], sigma_mm: NDArray[np.float64], used: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Leave out, one by one, channels that contradict the plane of all others (at most a quarter of them).

    Notes
    -----
    Leaving one out and predicting it finds a slip that a fit to all channels would hide by tilting.
    """
    kept = used.copy()
    for _ in range(int(np.count_nonzero(used)) // 4):
        worst, gap = -1, 0.0
        best = np.inf
        for k in np.flatnonzero(kept):
            others = kept.copy()
            others[k] = False
            if np.count_nonzero(others) < MIN_CHANNELS:
                return kept
            plane = fit_plane(receivers_mm, paths_mm, others)
            if plane is None:
                continue
            score = _chi_squared(paths_mm, plane.paths_mm, sigma_mm, others)
            if score < best:
                best, worst, gap = score, int(k), float(abs(paths_mm[k] - plane.paths_mm[k]))
        if worst < 0 or gap < max(SLIP_MM, 6.0 * float(sigma_mm[worst])):
            return kept
        kept[worst] = False
    return kept


def plane_contacts(plane: Plane, receivers_mm: Points3) -> Points3:
    """Where the sound of each receiver met the plane: on the line image -> receiver, (receivers, 3)."""
    along = plane.distance_mm / (2 * plane.distance_mm + receivers_mm @ plane.normal)
    return plane.image_mm + along[:, None] * (receivers_mm - plane.image_mm)


def axis_contacts(receivers_mm: Points3, paths_mm: NDArray[np.float64]) -> Points3:
    """Contact points if the surface were perpendicular to the array's axis, (receivers, 3)."""
    depth = 0.5 * np.sqrt(np.maximum(paths_mm**2 - np.sum(receivers_mm**2, axis=1), 0.0))
    return np.column_stack([0.5 * receivers_mm[:, 0], 0.5 * receivers_mm[:, 1], depth])


def contact(
    receivers_mm: Points3,
    paths_mm: NDArray[np.float64],
    sigma_mm: NDArray[np.float64],
    *,
    max_chi_squared: float = 6.0,
    max_tilt_rad: float = 0.45,
) -> Contact:
    """Choose the model that explains a ping's path lengths, and give each receiver its contact point.

    Parameters
    ----------
    receivers_mm : (receivers, 3) float64
        Relative to the emitter.
    paths_mm : (receivers,) float64
        Not a number where a channel has no echo.
    sigma_mm : (receivers,) float64
    max_chi_squared : float
        Per degree of freedom; a model above it is not believed.
    max_tilt_rad : float
        A plane tilted further than this off the array's axis cannot return its mirror image.

    Returns
    -------
    Contact
        `kind` NONE where neither model holds: then each receiver stands for itself, perpendicular to the axis.

    Notes
    -----
    A plane and a corner cannot be told apart from one pose.
    """
    require_shape("receivers_mm", receivers_mm, (None, 3))
    require_shape("paths_mm", paths_mm, (len(receivers_mm),))
    used = np.isfinite(paths_mm)
    up = np.tile([0.0, 0.0, -1.0], (len(receivers_mm), 1))
    alone = Contact(EchoKind.NONE, axis_contacts(receivers_mm, paths_mm), up, used, np.inf)
    if np.count_nonzero(used) < MIN_CHANNELS:
        return alone
    kept = used
    plane = fit_plane(receivers_mm, paths_mm, kept)
    if plane is None or _chi_squared(paths_mm, plane.paths_mm, sigma_mm, kept) > max_chi_squared:
        kept = without_slips(receivers_mm, paths_mm, sigma_mm, used)
        plane = fit_plane(receivers_mm, paths_mm, kept)
    point = fit_point(receivers_mm, paths_mm, kept)
    plane_score = _chi_squared(paths_mm, plane.paths_mm, sigma_mm, kept) if plane is not None else np.inf
    point_score = _chi_squared(paths_mm, point[1], sigma_mm, kept) if point is not None else np.inf
    if (
        plane is not None
        and plane_score <= min(point_score, max_chi_squared)
        and -plane.normal[2] >= np.cos(max_tilt_rad)
    ):
        normals = np.tile(plane.normal, (len(receivers_mm), 1))
        return Contact(EchoKind.PLANE, plane_contacts(plane, receivers_mm), normals, kept, plane_score)
    if (
        point is not None
        and point_score <= min(plane_score, max_chi_squared)
        and point[0][2] >= np.cos(max_tilt_rad) * np.linalg.norm(point[0])
    ):
        normal = -point[0] / np.linalg.norm(point[0])
        shape = (len(receivers_mm), 1)
        return Contact(EchoKind.POINT, np.tile(point[0], shape), np.tile(normal, shape), kept, point_score)
    return alone
