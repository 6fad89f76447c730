"""Primitives fitted to the paths of pings from several poses, from starts in closed form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from echolume_messages.geometry import Points3, require_shape
from echolume_messages.types import EchoKind
from echolume_processing.ultrasonic.contacts import contacts
from echolume_processing.ultrasonic.primitives import PARAMETERS, POSITIONS, Primitive, SurfaceKind, Vector

STARTS = 3
RADII_MM = (5.0, 60.0)
MAX_CALLS = 30


@dataclass(frozen=True)
class Scan:
    """Paths of pings from known poses, every pair of emitter and receiver a row; those without an echo left out."""

    emitter_mm: Points3
    receiver_mm: Points3
    paths_mm: NDArray[np.float64]
    sigma_mm: NDArray[np.float64]

    @property
    def range_mm(self) -> float:
        """Half the mean path."""
        return 0.5 * float(np.mean(self.paths_mm))


@dataclass(frozen=True)
class Fit:
    """A primitive fitted to a scan."""

    primitive: Primitive
    chi_squared: float
    """The whole sum."""
    freedom: int
    axes: Vector
    """Of `covariance`, see `Primitive.chart`."""
    covariance: NDArray[np.float64]
    """Of the free parameters, in mm^2; tilts are multiplied by `scale_mm`."""
    scale_mm: float
    determined: bool
    """Whether the poses determine every parameter better than the range itself."""

    @property
    def position_covariance(self) -> NDArray[np.float64]:
        """In mm^2, (3, 3); none along a plane or line."""
        count = POSITIONS[self.primitive.kind]
        return self.axes[:count].T @ self.covariance[:count, :count] @ self.axes[:count]


def scan_of(
    rig_from_emitter: NDArray[np.float64],
    receivers_mm: Points3,
    paths_mm: NDArray[np.float64],
    sigma_mm: NDArray[np.float64],
) -> Scan:
    """Rows of emitter, receiver and path in the rig frame.

    Parameters
    ----------
    rig_from_emitter : (pings, 4, 4) float64
        Poses of the frame whose origin is the emitter.
    receivers_mm : (receivers, 3) float64
        In that frame.
    paths_mm, sigma_mm : (pings, receivers) float64
        Not a number where there is no echo.
    """
    require_shape("rig_from_emitter", rig_from_emitter, (None, 4, 4))
    require_shape("paths_mm", paths_mm, (len(rig_from_emitter), len(receivers_mm)))
    require_shape("sigma_mm", sigma_mm, paths_mm.shape)
    heard = np.isfinite(paths_mm)
    place = rig_from_emitter[:, None, :3, 3]
    receivers = np.einsum("pij,rj->pri", rig_from_emitter[:, :3, :3], receivers_mm) + place
    emitters = np.broadcast_to(place, receivers.shape)
    return Scan(emitters[heard], receivers[heard], paths_mm[heard], sigma_mm[heard])


def fit_primitive(start: Primitive, scan: Scan) -> Fit:
    """Fit a primitive to all paths of a scan by Gauss-Newton steps (Levenberg-Marquardt) from a start.

    Notes
    -----
    A parameter that the poses leave open gets a variance of the range times ten, squared, and not an infinite one.
    """
    scale_mm, axes = scan.range_mm, start.chart()
    count = PARAMETERS[start.kind]

    def residuals(by: Vector) -> NDArray[np.float64]:
        return (scan.paths_mm - start.moved(axes, scale_mm, by).paths_mm(scan.emitter_mm, scan.receiver_mm)) / sigma

    sigma = scan.sigma_mm
    solved = least_squares(residuals, np.zeros(count), method="lm", x_scale="jac", max_nfev=MAX_CALLS * (count + 1))
    jacobian = np.asarray(solved.jac, dtype=np.float64)
    information = jacobian.T @ jacobian + np.eye(count) / (10 * scale_mm) ** 2
    covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return Fit(
        start.moved(axes, scale_mm, np.asarray(solved.x, dtype=np.float64)),
        2 * float(solved.cost),
        len(sigma) - count,
        axes,
        covariance,
        scale_mm,
        bool(np.sqrt(np.diag(covariance)).max() < scale_mm),
    )


def feet_of(
    rig_from_emitter: NDArray[np.float64], receivers_mm: Points3, paths_mm: NDArray[np.float64], sigma_mm: Vector
) -> tuple[Points3, Points3]:
    """Feet (halfway to the emitter's image) and directions to them, of each ping for itself, rig frame."""
    found = contacts(
        receivers_mm, paths_mm, sigma_mm, max_chi_squared=np.inf, max_tilt_rad=1.5, model="plane", untested=True
    )
    good = found.kind == EchoKind.PLANE
    if not good.any():
        raise ValueError("paths_mm: expected a ping with echoes enough for a plane; none of these has")
    pose = rig_from_emitter[good]
    feet = np.einsum("pij,pj->pi", pose[:, :3, :3], found.foot_mm[good]) + pose[:, :3, 3]
    return feet, -np.einsum("pij,pj->pi", pose[:, :3, :3], found.normals[good])


def starts(kind: SurfaceKind, feet: Points3, ways: Points3) -> list[Primitive]:
    """Where to begin, from the feet of single pings."""
    place, way = feet.mean(axis=0), ways.mean(axis=0)
    way = way / np.linalg.norm(way)
    none = np.zeros(3)
    if kind == SurfaceKind.PLANE:
        return [Primitive(kind, place, -way)]
    if kind == SurfaceKind.POINT:
        return [Primitive(kind, place, none)]
    if kind == SurfaceKind.SPHERE:
        return [Primitive(kind, place + r * way, none, r) for r in RADII_MM]
    across = np.linalg.svd(way[None])[2][1:]
    # A line is across all ways to it, and feet lie along it.
    lines = [np.linalg.eigh(ways.T @ ways)[1][:, 0], np.linalg.svd(feet - place)[2][0]]
    lines += [np.cos(t) * across[0] + np.sin(t) * across[1] for t in np.pi * np.arange(4) / 4]
    radii = RADII_MM if kind == SurfaceKind.CYLINDER else (0.0,)
    return [Primitive(kind, place + r * way, u, r) for u in lines for r in radii]


def chi_squared(primitive: Primitive, scan: Scan) -> float:
    """Weighted sum of squares of what the primitive leaves of the paths."""
    predicted = primitive.paths_mm(scan.emitter_mm, scan.receiver_mm)
    return float(np.sum(((scan.paths_mm - predicted) / scan.sigma_mm) ** 2))


def best_fit(kind: SurfaceKind, feet: Points3, ways: Points3, scan: Scan, also: tuple[Primitive, ...] = ()) -> Fit:
    """The best of the fits from the most promising starts, and from those given."""
    begin = sorted(starts(kind, feet, ways), key=lambda p: chi_squared(p, scan))[:STARTS]
    begun = min((fit_primitive(p, scan) for p in (*also, *begin)), key=lambda f: f.chi_squared)
    # again from the answer, so that the covariance is of it
    return fit_primitive(begun.primitive, scan)
