"""What each ping says by itself: the plane that its echo met, from the contact points of its receivers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from echolume_messages.calibration import ArrayCalibration
from echolume_messages.types import EchoKind, Structured
from echolume_processing.hybrid.model import Registration
from echolume_processing.hybrid.plates import Plane
from echolume_processing.hybrid.scipy_typed import NearestPoints
from echolume_processing.hybrid.setup_error import faster, turns
from echolume_processing.hybrid.sounding import Sounding
from echolume_processing.ping import Ping
from echolume_processing.ultrasonic.pipeline import UltrasonicPipeline

LEAST_RECEIVERS = 4
TOGETHER_MM = 6.0
"""Paths of one echo to the receivers of an array differ by no more."""
LEAST_NZ = 0.85
"""Steeper planes send no echo back to where an array over the bench stands."""
NEIGHBOURS = 1.8
"""Contacts belong together up to so many times their spacing."""
REACH_MM = 70.0
"""A contact vouches for its plane so far around it."""
OFF_MM = 0.6
OFF_PER_MM = 0.012
"""Contacts of one plane agree to `OFF_MM`, and to this more for every millimetre between them: their normals err."""
SAME_NORMAL = 0.995
LEVER_MM = 8.0
"""A contact's normal weighs like its height over this distance."""
FIT_OFF_MM = 0.5
LEAST_CONTACTS = 3


@dataclass(frozen=True)
class Heard:
    """One contact per ping: place and unit normal, (pings, 3) in the rig frame; not a number where there is none."""

    place_mm: NDArray[np.float64]
    normal: NDArray[np.float64]
    path_mm: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))
    """Path of the first echo to each receiver, whatever it met; not a number where one heard a later echo, or none
    (pings, receivers)."""

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Pings that met a plane, (pings,)."""
        return np.isfinite(self.place_mm[:, 2])

    def following(self, found: Sounding, registration: Registration) -> Heard:
        """What the same echoes say of a set-up that was registered.

        Parameters
        ----------
        found
            The pings as they were before.
        registration
            By what their array was moved, and by what sound was faster than they took it for.

        Notes
        -----
        Contacts move with their array, and are further from it by as much as sound was faster.
        """
        value = registration.errors(found.speed_mps)
        longer = 1 + faster(value, found.order)[:, None]
        about_rig, about_emitter = turns(value)
        emitter_mm = np.array([a.elements_mm[0] for a in found.apertures])
        arm_mm = (self.place_mm - emitter_mm) * longer
        return Heard(
            arm_mm @ about_emitter.T + emitter_mm @ about_rig.T + value[[3, 4, 0]],
            self.normal @ about_emitter.T,
            self.path_mm * longer[: len(self.path_mm)],
        )


@dataclass(frozen=True)
class Seed:
    """A plane that several neighbouring pings met."""

    plane: Plane
    which: NDArray[np.int64]
    """Pings that met it, sorted."""
    place_mm: NDArray[np.float64]
    """x and y of the places where they did, or of the feet of the pings that are to be explained, shape (n, 2)."""
    spread_mm: float
    """Robust standard deviation of the pings' own heights over the plane."""

    @property
    def sigma_mm(self) -> float:
        """Standard deviation of the plane's height."""
        return max(0.05, self.spread_mm / float(np.sqrt(self.which.size)))


def heard(pings: Sequence[Ping], calibration: ArrayCalibration) -> Heard:
    """Contact of each ping."""
    pipeline = UltrasonicPipeline(calibration)
    receivers = len(calibration.receivers_mm)
    return together([contact(pipeline.process(ping), receivers) for ping in pings])


Contact = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
"""Place and unit normal of what one ping met, (3,) each, and its first echo's path to each receiver."""


def contact(points: Structured, receivers: int) -> Contact:
    """Contact of one ping: the middle of its receivers' contact points (``ULTRASONIC_POINT``)."""
    nothing, path_mm = np.full(3, np.nan), _first_paths_mm(points, receivers)
    points = points[points["kind"] == EchoKind.PLANE]
    if points.size < LEAST_RECEIVERS:
        return nothing, nothing, path_mm
    normal = np.array([np.median(points[name].astype(np.float64)) for name in ("nx", "ny", "nz")])
    normal = np.asarray(normal / np.linalg.norm(normal), dtype=np.float64)
    if normal[2] < LEAST_NZ:
        return nothing, nothing, path_mm
    place_mm = [float(np.mean(points[name].astype(np.float64))) for name in ("x_mm", "y_mm", "z_mm")]
    return np.array(place_mm), normal, path_mm


def _first_paths_mm(points: Structured, receivers: int) -> NDArray[np.float64]:
    """Path to each receiver that heard the first of a ping's echoes; none if it is too few of them."""
    path_mm = np.full(receivers, np.nan)
    path_mm[points["receiver"]] = points["path_mm"]
    with np.errstate(invalid="ignore"):
        first = path_mm <= np.nanmin(path_mm, initial=np.inf) + TOGETHER_MM
    return np.where(first & (first.sum() >= LEAST_RECEIVERS), path_mm, np.nan)


def together(contacts: Sequence[Contact]) -> Heard:
    """The contacts of several pings, in their order."""
    place_mm, normal = (np.array([each[k] for each in contacts]).reshape(-1, 3) for k in range(2))
    return Heard(place_mm, normal, np.array([each[2] for each in contacts]))


def seeds(found: Heard, among: NDArray[np.int64]) -> list[Seed]:
    """Planes that some pings met, the one that most of them met first.

    Parameters
    ----------
    among
        Pings to be explained; those that met no plane have no say.

    Notes
    -----
    Every contact proposes the plane through it; the proposal that most others within `REACH_MM` agree with, in height
    and in normal, is fitted to them, and they leave. Only what hangs together counts.
    """
    left = among[found.valid[among]]
    out: list[Seed] = []
    while left.size >= LEAST_CONTACTS:
        place, normal = found.place_mm[left], found.normal[left]
        apart = place[None, :, :] - place[:, None, :]  # from each proposal to each other contact
        away = np.linalg.norm(apart[..., :2], axis=2)
        off = np.abs(np.einsum("ijk,ik->ij", apart, normal))
        agree = (off <= OFF_MM + OFF_PER_MM * away) & (away <= REACH_MM) & (normal @ normal.T >= SAME_NORMAL)
        best = int(np.argmax(agree.sum(axis=1)))
        members = _connected(place[:, :2], np.nonzero(agree[best])[0], best)
        if members.size < LEAST_CONTACTS:
            left = np.delete(left, best)
            continue
        plane = _fit(place[members], normal[members])
        off_mm = place[:, 2] - plane.at(place[:, 0], place[:, 1])
        close = (np.abs(off_mm) <= 2 * FIT_OFF_MM) & (normal @ _normal(plane) >= SAME_NORMAL)
        members = _connected(place[:, :2], np.nonzero(close)[0], best)
        if members.size >= LEAST_CONTACTS:
            plane = _fit(place[members], normal[members])
            off_mm = place[:, 2] - plane.at(place[:, 0], place[:, 1])
            spread_mm = 1.4826 * float(np.median(np.abs(off_mm[members])))
            out.append(Seed(plane, left[members], place[members, :2], spread_mm))
        left = np.delete(left, np.union1d(members, [best]))
    return sorted(out, key=lambda seed: (-seed.which.size, int(seed.which[0])))


def _connected(place_mm: NDArray[np.float64], members: NDArray[np.int64], first: int) -> NDArray[np.int64]:
    """Those members that hang together with the first by steps between neighbours."""
    if members.size < LEAST_CONTACTS or place_mm.shape[0] < 2:
        return members[:0]
    step_mm = NEIGHBOURS * max(8.0, NearestPoints(place_mm).spacing())
    near = np.linalg.norm(place_mm[members][:, None] - place_mm[members][None], axis=2) <= step_mm
    reached = members == first
    for _ in range(members.size):
        more = near[reached].any(axis=0) if reached.any() else reached
        if not (more & ~reached).any():
            break
        reached |= more
    return members[reached]


def _normal(plane: Plane) -> NDArray[np.float64]:
    direction = np.array([-plane.slope_x, -plane.slope_y, 1.0])
    return direction / np.linalg.norm(direction)


def _fit(place_mm: NDArray[np.float64], normal: NDArray[np.float64]) -> Plane:
    """Plane through contacts by their heights and normals, twice, the second time without those far off."""
    middle = place_mm[:, :2].mean(axis=0)
    across = place_mm[:, :2] - middle
    ones, zeros = np.ones(len(across)), np.zeros(len(across))
    rows = np.concatenate(
        (
            np.column_stack((ones, across)),
            LEVER_MM * np.column_stack((zeros, ones, zeros)),
            LEVER_MM * np.column_stack((zeros, zeros, ones)),
        )
    )
    target = np.concatenate((place_mm[:, 2], *(-LEVER_MM * (normal[:, :2] / normal[:, 2:])).T))
    solution = np.linalg.lstsq(rows, target, rcond=None)[0]
    good = np.abs(target - rows @ solution) <= np.maximum(FIT_OFF_MM, np.median(np.abs(target - rows @ solution)))
    solution = np.linalg.lstsq(rows[good], target[good], rcond=None)[0]
    return Plane(float(middle[0]), float(middle[1]), *(float(v) for v in solution))
