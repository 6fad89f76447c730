"""Plane, point, edge, corner, cylinder and sphere told apart from the pings of several poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import Points3, rotation_from_vector, transform
from echolume_processing.ultrasonic.contacts import MAX_CHI_SQUARED
from echolume_processing.ultrasonic.primitives import PARAMETERS, WIDER, SurfaceKind
from echolume_processing.ultrasonic.surface_fit import Fit, Scan, best_fit, feet_of, scan_of

SURE = 9.0
"""Chi-squared by which a kind must lose to be excluded."""
EVERY = (
    SurfaceKind.PLANE,
    SurfaceKind.POINT,
    SurfaceKind.EDGE,
    SurfaceKind.CORNER,
    SurfaceKind.CYLINDER,
    SurfaceKind.SPHERE,
)


@dataclass(frozen=True)
class Surface:
    """What the pings say that they met."""

    kind: SurfaceKind
    """NONE if no primitive has such paths."""
    fits: dict[SurfaceKind, Fit]
    rivals: tuple[SurfaceKind, ...]
    """Kinds that these poses do not exclude, best first: motion must, see `separating_motions`."""

    @property
    def ambiguous(self) -> bool:
        """Whether another kind explains the pings as well."""
        return bool(self.rivals)

    @property
    def best(self) -> Fit:
        """The fit of the chosen kind.

        Raises
        ------
        ValueError
            If there is none.
        """
        if self.kind == SurfaceKind.NONE:
            raise ValueError("surface: no primitive explains these pings; look at `fits`, or scan a smaller patch")
        return self.fits[self.kind]


def classify(
    rig_from_emitter: NDArray[np.float64],
    receivers_mm: Points3,
    paths_mm: NDArray[np.float64],
    sigma_mm: NDArray[np.float64],
    *,
    kinds: Sequence[SurfaceKind] = EVERY,
    max_chi_squared: float = MAX_CHI_SQUARED,
) -> Surface:
    """Tell which primitive the pings of several poses met, and where it is.

    Parameters
    ----------
    rig_from_emitter : (pings, 4, 4) float64
        Poses of the frame whose origin is the emitter, z towards the scene.
    receivers_mm : (receivers, 3) float64
        In that frame.
    paths_mm, sigma_mm : (pings, receivers) float64
        Cycle slips left out or resolved before; not a number where there is no echo.
    kinds : sequence of SurfaceKind
        To choose from.
    max_chi_squared : float
        Per degree of freedom; a kind above it is not believed.

    Returns
    -------
    Surface
        Of the kinds that chi-squared does not exclude (9 above the least) the one with the fewest parameters; the
        others are its `rivals`, unless they are generalisations of it.

    Notes
    -----
    All paths of all poses are fitted at once, from starts in closed form. From one pose a plane and a corner have the
    same paths, and over a plane two poses do not exclude the corner whose line runs through both feet. A cylinder or
    sphere whose radius is not significant is an edge, point or plane; a radius below 0 is that of a hollow.

    References
    ----------
    Barshan and Sekmen, J. Acoust. Soc. Am. 106 (1999), doi:10.1121/1.427148: plane, line, point, cylinder and sphere as
    one family.
    """
    scan = scan_of(rig_from_emitter, receivers_mm, paths_mm, sigma_mm)
    feet, ways = feet_of(rig_from_emitter, receivers_mm, paths_mm, sigma_mm)
    fits: dict[SurfaceKind, Fit] = {}
    for kind in kinds:
        if len(scan.paths_mm) > PARAMETERS[kind]:
            fits[kind] = best_fit(kind, feet, ways, scan)
    return _chosen(fits, max_chi_squared)


def _chosen(fits: dict[SurfaceKind, Fit], max_chi_squared: float) -> Surface:
    order = sorted(fits.values(), key=lambda f: f.chi_squared)
    if not order or min(f.chi_squared / f.freedom for f in order) > max_chi_squared:
        return Surface(SurfaceKind.NONE, fits, ())
    least = order[0].chi_squared
    limit = least + SURE * max(1.0, least / order[0].freedom)
    left = sorted(
        (f for f in order if f.chi_squared < limit), key=lambda f: (PARAMETERS[f.primitive.kind], f.chi_squared)
    )
    kind = left[0].primitive.kind
    rivals = [f for f in left[1:] if f.primitive.kind not in WIDER.get(kind, ())]
    rivals.sort(key=lambda f: f.chi_squared)
    return Surface(kind, fits, tuple(f.primitive.kind for f in rivals))


@dataclass(frozen=True)
class Motion:
    """Further poses of the array, and what they would tell."""

    name: str
    emitter_from_moved: NDArray[np.float64]
    """(poses, 4, 4), from the frame of the last pose."""
    sigmas: float
    """By which the rival would fail to explain the pings there; below 3 they do not tell."""


def motions(step_mm: float, turn_rad: float) -> dict[str, NDArray[np.float64]]:
    """Steps along and turns about the array's own axes, and two steps across, by name."""
    axes = np.eye(3)
    steps = [transform(axes, step_mm * axis) for axis in axes]
    turns = [transform(rotation_from_vector(turn_rad * axis), np.zeros(3)) for axis in axes[:2]]
    alone = dict(zip(("step x", "step y", "step z", "turn x", "turn y"), (*steps, *turns), strict=True))
    return {name: move[None] for name, move in alone.items()} | {"steps x and y": np.array(steps[:2])}


def separating_motions(
    surface: Surface,
    rival: SurfaceKind,
    rig_from_emitter: NDArray[np.float64],
    receivers_mm: Points3,
    sigma_mm: NDArray[np.float64],
    candidates: Mapping[str, NDArray[np.float64]],
) -> list[Motion]:
    """Which motion from the last pose would exclude a rival if the chosen kind is right, best first.

    Parameters
    ----------
    surface : Surface
        Of `classify`.
    rival : SurfaceKind
        One of its `rivals`.
    rig_from_emitter : (pings, 4, 4) float64
        As given to `classify`.
    receivers_mm : (receivers, 3) float64
    sigma_mm : (receivers,) float64
        Of a ping's paths.
    candidates : mapping of (poses, 4, 4) float64
        In the array's frame, as of `motions`.

    Notes
    -----
    The chosen kind predicts the paths of all poses and of the new ones; what the rival, fitted again to these, leaves
    unexplained is what the motion would show.
    """
    out: list[Motion] = []
    for name, moved in candidates.items():
        poses = np.concatenate([rig_from_emitter, rig_from_emitter[-1] @ moved])
        shape = (len(poses), len(receivers_mm))
        rows = scan_of(poses, receivers_mm, np.ones(shape), np.broadcast_to(sigma_mm, shape))
        paths_mm = surface.best.primitive.paths_mm(rows.emitter_mm, rows.receiver_mm)
        told = Scan(rows.emitter_mm, rows.receiver_mm, paths_mm, rows.sigma_mm)
        feet, ways = feet_of(poses, receivers_mm, paths_mm.reshape(shape), rows.sigma_mm.reshape(shape))
        left = best_fit(rival, feet, ways, told, (surface.fits[rival].primitive,)).chi_squared
        out.append(Motion(name, moved, float(np.sqrt(left))))
    return sorted(out, key=lambda m: -m.sigmas)
