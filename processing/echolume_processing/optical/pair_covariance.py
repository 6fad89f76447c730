"""How well the views determine two cameras: covariance of intrinsics, distortion and relative pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages import geometry
from echolume_messages.errors import CalibrationRejectedError
from echolume_processing.optical.board import CalibrationBoard
from echolume_processing.optical.pair_solver import ADVICE, BoardView, PairSolution, adjoint, jacobian

Values = NDArray[np.float64]

_OF_CAMERA = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3")
NAMES = (
    *(f"left {name}" for name in _OF_CAMERA),
    *(f"right {name}" for name in _OF_CAMERA),
    *(f"right_from_left {name}" for name in ("rx_rad", "ry_rad", "rz_rad", "x_mm", "y_mm", "z_mm")),
)
"""What the rows of the covariance stand for; rotations are small ones in the right camera's frame."""
_K3 = 8, 17
WORST_CONDITION = 1e12


@dataclass(frozen=True)
class PairCovariance:
    """Covariance of the cameras' parameters.

    Attributes
    ----------
    matrix : (24, 24) float64
        In the order of `NAMES`; zero for a k3 that was held.
    noise_px : float
        Standard deviation of a corner's coordinate, from what the fit leaves over.
    """

    matrix: Values
    noise_px: float

    @property
    def sigmas(self) -> dict[str, float]:
        """Standard deviation of each parameter that was free, by name."""
        sigma = np.sqrt(np.diag(self.matrix))
        return {name: float(s) for name, s in zip(NAMES, sigma, strict=True) if s > 0}


def pair_covariance(found: PairSolution, views: Sequence[BoardView], board: CalibrationBoard) -> PairCovariance:
    """Covariance of both cameras' parameters, the boards' poses being unknown too.

    Parameters
    ----------
    found : PairSolution
        The least-squares solution.
    views : sequence of BoardView
        The views it is of, in the same order.
    board : CalibrationBoard

    Returns
    -------
    PairCovariance

    Raises
    ------
    CalibrationRejectedError
        If the views leave a parameter open.

    Notes
    -----
    ``noise^2 (J^T J)^-1`` with the poses eliminated view by view (Schur complement). Errors that neighbouring corners
    share, such as those of a board that is not flat, are not in it: then the truth lies further off.
    """
    total = len(NAMES)
    normal = np.zeros((total, total))
    squares, count = 0.0, 0
    extrinsic = slice(18, 24)
    for view, pose in zip(views, found.left_from_board, strict=True):
        shape = view.shape_mm(board)
        own, cross, pose_normal = np.zeros((total, total)), np.zeros((total, 6)), np.zeros((6, 6))
        sides = ((found.left, view.left_px, 0), (found.right, view.right_px, 9))
        for camera, seen_px, first in sides:
            pixels, columns = jacobian(camera, geometry.apply(camera.camera_from_rig @ pose, shape))
            j = np.zeros((len(columns), total))
            j[:, first : first + 9] = columns[:, 6:15]
            if first:
                j[:, extrinsic] = columns[:, :6]
            j_pose = columns[:, :6] @ adjoint(camera.camera_from_rig)
            own += j.T @ j
            cross += j.T @ j_pose
            pose_normal += j_pose.T @ j_pose
            residual = seen_px - pixels
            squares += float(np.sum(residual**2))
            count += residual.size
        normal += own - cross @ np.linalg.solve(pose_normal, cross.T)
    free = np.ones(total, dtype=np.bool_)
    if not found.third_radial:
        free[list(_K3)] = False
    unknowns = int(free.sum()) + 6 * len(views)
    variance = squares / max(count - unknowns, 1)
    kept = normal[np.ix_(free, free)]
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1 / np.sqrt(np.diag(kept))  # focal lengths and distortions differ by many orders of magnitude
    scaled = kept * np.outer(scale, scale)
    if not np.isfinite(scaled).all() or float(np.linalg.cond(scaled)) > WORST_CONDITION:
        raise CalibrationRejectedError(f"calibrate cameras: rejected: the views do not determine the cameras: {ADVICE}")
    out = np.zeros((total, total))
    out[np.ix_(free, free)] = variance * scale[:, None] * np.linalg.inv(scaled) * scale
    return PairCovariance(out, float(np.sqrt(variance)))
