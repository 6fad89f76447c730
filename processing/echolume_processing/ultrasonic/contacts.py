"""Contact points of many pings at once."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import Points3, require_shape
from echolume_processing.ultrasonic import contact_kernels as at
from echolume_processing.ultrasonic.layout import Layout, layout_of
from echolume_processing.ultrasonic.ping_kernels import contact_rows

MAX_CHI_SQUARED = 6.0
MAX_TILT_RAD = 0.45
SLIP_MM = 1.5
"""A channel that lies this far from what all others agree on has slipped a cycle or seen another echo."""
SLIP_SIGMAS = 6.0
MODELS = {"plane": 1.0, "point": 2.0, "both": 3.0}

SYMMETRIC = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
"""Where in its six numbers (xx, xy, xz, yy, yz, zz) each entry of a symmetric matrix is."""


@dataclass(frozen=True)
class Contacts:
    """Contact points of pings, in the frame of the emitter; everything is a view into one row per ping.

    Covariances are six numbers, xx, xy, xz, yy, yz, zz (`full` spreads them), infinite where the layout determines
    nothing, not a number where no model holds.
    """

    layout: Layout
    rows: NDArray[np.float64]
    """(pings, 22 + 9 receivers), as `contact_kernels` says."""
    used: NDArray[np.bool_]
    """Receivers that a ping's contact rests on, (pings, receivers)."""

    @property
    def kind(self) -> NDArray[np.uint8]:
        """EchoKind of each ping, (pings,)."""
        return self.rows[:, at.KIND].astype(np.uint8)

    @property
    def rank(self) -> NDArray[np.uint8]:
        """0: no path; 1: range only; 2: also the tilt along the receivers' line; 3: range and both tilts. (pings,)."""
        return self.rows[:, at.RANK].astype(np.uint8)

    @property
    def plane_chi_squared(self) -> NDArray[np.float64]:
        """Per degree of freedom, not a number where nothing was left to test, (pings,)."""
        return self.rows[:, at.PLANE_CHI]

    @property
    def point_chi_squared(self) -> NDArray[np.float64]:
        """Per degree of freedom, (pings,)."""
        return self.rows[:, at.POINT_CHI]

    @property
    def foot_mm(self) -> Points3:
        """Foot of the perpendicular from the emitter on a plane, or the point, (pings, 3)."""
        return self.rows[:, at.TARGET : at.TARGET + 3]

    @property
    def normals(self) -> Points3:
        """Unit normal towards the array, (pings, 3)."""
        return self.rows[:, at.NORMAL : at.NORMAL + 3]

    @property
    def foot_covariance(self) -> NDArray[np.float64]:
        """In mm^2, (pings, 6)."""
        return self.rows[:, at.FOOT_COV : at.FOOT_COV + 6]

    @property
    def normal_covariance(self) -> NDArray[np.float64]:
        """Singular along the normal, (pings, 6)."""
        return self.rows[:, at.NORMAL_COV : at.NORMAL_COV + 6]

    @property
    def points_mm(self) -> NDArray[np.float64]:
        """Contact point of each receiver, used or not, (pings, receivers, 3)."""
        pings, receivers = self.used.shape
        return self.rows[:, at.POINTS : at.POINTS + 3 * receivers].reshape(pings, receivers, 3)

    @property
    def point_covariance(self) -> NDArray[np.float64]:
        """In mm^2, of each receiver's contact point, (pings, receivers, 6)."""
        pings, receivers = self.used.shape
        return self.rows[:, at.POINTS + 3 * receivers :].reshape(pings, receivers, 6)


def full(six: NDArray[np.float64]) -> NDArray[np.float64]:
    """Symmetric matrices (..., 3, 3) of their six numbers (..., 6)."""
    return six[..., SYMMETRIC]


def contacts(
    receivers_mm: Points3,
    paths_mm: NDArray[np.float64],
    sigma_mm: NDArray[np.float64],
    *,
    common_sigma_mm: float = 0.0,
    max_chi_squared: float = MAX_CHI_SQUARED,
    max_tilt_rad: float = MAX_TILT_RAD,
    model: Literal["plane", "point", "both"] = "both",
    untested: bool = False,
    leave_out: bool = True,
    rows: NDArray[np.float64] | None = None,
) -> Contacts:
    """Choose the model that explains each ping's path lengths, and give each receiver its contact point.

    Parameters
    ----------
    receivers_mm : (receivers, 3) float64
        Relative to the emitter, z towards the scene; any layout, see `layout.layout_of`.
    paths_mm : (pings, receivers) float64
        Emitter, surface, receiver; not a number where a channel has no echo.
    sigma_mm : (receivers,) or (pings, receivers) float64
        Standard deviation of each path for itself; channels weigh by it.
    common_sigma_mm : float
        Of what all paths of a ping share: sound's speed, the robot's pose. It widens the covariances only.
    max_chi_squared : float
        Per degree of freedom; a model above it is not believed.
    max_tilt_rad : float
        A target further than this off the array's axis cannot return an echo.
    model : "plane", "point" or "both"
        Which models may explain a ping.
    untested : bool
        Believe the plane (or the point, if it alone is asked) where there are just enough paths to fit it and none to
        test it, as for R-E-R; else such pings are EchoKind.NONE.
    leave_out : bool
        Leave out channels that contradict all others.
    rows : (pings, 22 + 9 receivers) float64, optional
        Memory for the result.

    Notes
    -----
    Closed form, weighted, and on the Cramer-Rao bound; receivers out of the emitter's plane cost one Gauss-Newton step.
    Where neither model holds, one channel or two (a quarter of them at most) that contradict all others by more than
    1.5 mm and 6 sigmas are left out, if it is beyond doubt which (9 of chi-squared); if none is, the ping is
    EchoKind.NONE, and each receiver stands for itself, perpendicular to the axis. A plane and a corner cannot be told
    apart from one pose.

    References
    ----------
    The paper, section 3.2 and figure 5.
    """
    layout = layout_of(receivers_mm)
    n = len(layout.columns)
    require_shape("paths_mm", paths_mm, (None, n))
    sigmas = _writable(sigma_mm)
    if sigmas.shape == (n,):
        sigmas = sigmas[None]
    elif sigmas.shape != paths_mm.shape:
        raise ValueError(f"sigma_mm: expected shape ({n},) or {paths_mm.shape}, got {sigmas.shape}")
    pings = len(paths_mm)
    width = at.POINTS + 9 * n
    if rows is None:
        rows = np.empty((pings, width))
    elif rows.shape != (pings, width) or rows.dtype != np.float64 or not rows.flags.c_contiguous:
        raise ValueError(f"rows: expected contiguous float64 of shape {(pings, width)}, got {rows.dtype} {rows.shape}")
    used = np.empty((pings, n), dtype=np.bool_)
    limits = (
        max_chi_squared,
        SLIP_MM if leave_out else np.inf,
        SLIP_SIGMAS,
        cos(max_tilt_rad),
        MODELS[model],
        float(untested),
        common_sigma_mm,
    )
    contact_rows(
        layout.columns,
        layout.ridge,
        layout.rank,
        layout.deep,
        np.array(limits),
        _writable(paths_mm),
        sigmas,
        used,
        rows,
    )
    found = Contacts(layout, rows, used)
    if layout.rank < 3:
        _open_up(found)
    return found


def _writable(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """As the kernel takes arrays, which must not be read-only."""
    out = np.ascontiguousarray(values, dtype=np.float64)
    return out if out.flags.writeable else out.copy()


def _open_up(found: Contacts) -> None:
    """Make variances infinite along the directions that the layout leaves undetermined."""
    away = sum(np.outer(v, v) for v in found.layout.undetermined)
    entries = np.asarray(away)[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    unknown = np.abs(entries) > 1e-12
    for covariance in (found.foot_covariance, found.normal_covariance, found.point_covariance):
        known = np.isfinite(covariance[..., :1])
        covariance[..., unknown] = np.where(known, np.copysign(np.inf, entries[unknown]), np.nan)
