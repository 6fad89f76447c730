"""Seeds for plates: which height each ping would give to a plate below it, and the plane through those heights."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from echolume_messages.plan import MapField
from echolume_processing.hybrid.arcs import Arc
from echolume_processing.hybrid.model import cell_centres_mm
from echolume_processing.hybrid.predict import Aperture
from echolume_processing.hybrid.sounding import CEILING_MM, Sounding, Spectra

HEIGHT_STEP_MM = 0.25
LOWEST_MM = -5.0
FIT_ROUNDS = 20
NEAREST_ROUNDS = 12
LEAST_SIZE = 0.1
"""Newton's determinant is taken to be no smaller: a hollow surface may have no nearest point."""
STEEPEST = 0.4
"""No plate is sought beyond this slope: its echo would miss the array everywhere."""


@dataclass(frozen=True)
class Plane:
    """A plane, or what is bent from one; z_mm, slopes and bends are the surface's own at x_mm, y_mm.

    Along its two main directions a bent surface follows circular arcs, and its height is the sum of both: exact for a
    level cylinder, off by the fourth power of the distance for a ball (30 mm in radius: by 0.5 mm at 20 mm, midway
    between the directions, which are arbitrary there).
    """

    x_mm: float
    y_mm: float
    z_mm: float
    slope_x: float = 0.0
    slope_y: float = 0.0
    bend_xx: float = 0.0
    bend_xy: float = 0.0
    bend_yy: float = 0.0
    """Second derivatives, 1/mm."""

    @property
    def bent(self) -> bool:
        """Whether it is no plane."""
        return (self.bend_xx, self.bend_xy, self.bend_yy) != (0.0, 0.0, 0.0)

    @property
    def level(self) -> bool:
        """Whether it is a level plane."""
        return self.slope_x == self.slope_y == 0.0 and not self.bent

    def at(self, x_mm: NDArray[np.float64], y_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Height at points."""
        dx, dy = x_mm - self.x_mm, y_mm - self.y_mm
        if not self.bent:
            return self.z_mm + self.slope_x * dx + self.slope_y * dy
        axes, one, other = self._arcs
        return self.z_mm + one.at(axes[0, 0] * dx + axes[1, 0] * dy)[0] + other.at(axes[0, 1] * dx + axes[1, 1] * dy)[0]

    def slope_at(
        self, x_mm: NDArray[np.float64], y_mm: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """dz/dx and dz/dy at points."""
        dx, dy = x_mm - self.x_mm, y_mm - self.y_mm
        if not self.bent:
            flat = np.zeros_like(dx)
            return flat + self.slope_x, flat + self.slope_y
        axes, one, other = self._arcs
        s, t = one.at(axes[0, 0] * dx + axes[1, 0] * dy)[1], other.at(axes[0, 1] * dx + axes[1, 1] * dy)[1]
        return axes[0, 0] * s + axes[0, 1] * t, axes[1, 0] * s + axes[1, 1] * t

    @property
    def _arcs(self) -> tuple[NDArray[np.float64], Arc, Arc]:
        """Main directions, the columns (2, 2), and the arc along each of them."""
        bends, axes = np.linalg.eigh([[self.bend_xx, self.bend_xy], [self.bend_xy, self.bend_yy]])
        slopes = axes.T @ np.array([self.slope_x, self.slope_y])
        return axes, Arc(float(slopes[0]), float(bends[0])), Arc(float(slopes[1]), float(bends[1]))

    def image(self, field: MapField) -> NDArray[np.float64]:
        """Height at each cell of a field."""
        return self.at(*np.meshgrid(*cell_centres_mm(field)))

    def slopes(self, field: MapField) -> NDArray[np.float64]:
        """dz/dx and dz/dy at each cell of a field, shape (rows, columns, 2)."""
        return np.stack(self.slope_at(*np.meshgrid(*cell_centres_mm(field))), axis=2)

    def mirror_points(self, centre_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """x and y of the foot of the perpendicular from each point (n, 3), shape (n, 2)."""
        if self.bent:
            return self._nearest(centre_mm)
        slope = np.array([self.slope_x, self.slope_y])
        above = (centre_mm[:, 2] - self.at(centre_mm[:, 0], centre_mm[:, 1])) / (1 + slope @ slope)
        return centre_mm[:, :2] + above[:, None] * slope

    def _nearest(self, centre_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Newton's way to where the line to each point stands upright on the surface, along its main directions."""
        axes, one, other = self._arcs
        here = np.array([self.x_mm, self.y_mm])
        u0, v0 = ((centre_mm[:, :2] - here) @ axes).T
        u, v = one.short_of(u0), other.short_of(v0)  # from beyond an arc's end Newton overshoots
        for _ in range(NEAREST_ROUNDS):
            (zu, su, bu), (zv, sv, bv) = one.at(u), other.at(v)
            below = self.z_mm + zu + zv - centre_mm[:, 2]
            gu, gv = u - u0 + below * su, v - v0 + below * sv
            uu, vv, uv = 1 + su * su + below * bu, 1 + sv * sv + below * bv, su * sv
            size = np.maximum(uu * vv - uv * uv, LEAST_SIZE)
            u, v = u - (vv * gu - uv * gv) / size, v - (uu * gv - uv * gu) / size
        return here + np.column_stack((u, v)) @ axes.T

    def raised(self, dz_mm: float) -> Plane:
        """The same, higher by `dz_mm`."""
        return replace(self, z_mm=self.z_mm + dz_mm)


@dataclass(frozen=True)
class PingHeights:
    """Height of the horizontal plate that explains each ping best, and how well (correlation); both (pings,)."""

    which: NDArray[np.int64]
    height_mm: NDArray[np.float64]
    likeness: NDArray[np.float64]
    stacked: NDArray[np.float64]
    """Sum over the pings of the correlation with a plate at each of `heights_mm`."""

    def some(self, chosen: NDArray[np.bool_]) -> PingHeights:
        """The same of some of the pings."""
        return PingHeights(self.which[chosen], self.height_mm[chosen], self.likeness[chosen], self.stacked)

    def candidates(self, most: int, apart_mm: float) -> list[float]:
        """Heights at which all pings together see a plate, the likeliest first, at least `apart_mm` apart."""
        left, out = self.stacked.copy(), list[float]()
        heights_mm = tried_heights_mm()
        while len(out) < most and np.isfinite(left).any():
            top = int(np.argmax(left))
            out.append(float(heights_mm[top]))
            left[np.abs(heights_mm - heights_mm[top]) < apart_mm] = -np.inf
        return out


def tried_heights_mm() -> NDArray[np.float64]:
    """The heights at which a plate is sought."""
    return np.arange(LOWEST_MM, CEILING_MM, HEIGHT_STEP_MM)


def ping_heights(found: Sounding, which: NDArray[np.int64], predicted: Spectra | None = None) -> PingHeights:
    """Correlate pings with the image-source echo of a horizontal plate at every height.

    Parameters
    ----------
    predicted
        Echoes of these pings that are explained already: what they leave over is correlated; None: all of the echo.

    Notes
    -----
    A narrow-band pulse gives almost the same likeness every half wavelength; the plane through many pings has
    the same ambiguity, and only the whole waveform model can judge it.
    """
    heights_mm = tried_heights_mm()
    stacked = np.zeros(heights_mm.size)
    waveform = found.measured[which] if predicted is None else found.measured[which] - found.gate.waveform(predicted)
    measured = found.gate.spectrum(waveform)[..., :: found.gate.thinning]
    best_mm, like = np.empty(which.size), np.empty(which.size)
    for n, k in enumerate(which):
        plates = _plate_spectra(found, found.apertures[int(k)], heights_mm)
        match = np.tensordot(plates.conj(), measured[n], axes=([1, 2], [0, 1])).real
        match /= np.sqrt((np.abs(plates) ** 2).sum(axis=(1, 2)) * (np.abs(measured[n]) ** 2).sum())
        stacked += match
        top = int(match.argmax())
        best_mm[n], like[n] = heights_mm[top], match[top]
    return PingHeights(which, best_mm, like, stacked)


def _plate_spectra(found: Sounding, where: Aperture, heights_mm: NDArray[np.float64]) -> NDArray[np.complex64]:
    """Spectra (heights, receivers, bins) of endless horizontal plates, by the image of the emitter."""
    emitter, receivers = where.elements_mm[0], where.elements_mm[1:]
    image = np.repeat(emitter[None, :], heights_mm.size, axis=0)
    image[:, 2] = 2 * heights_mm - emitter[2]
    ray = receivers[None, :, :] - image[:, None, :]
    path_mm = np.linalg.norm(ray, axis=2)  # (heights, receivers)
    thin = slice(None, None, found.gate.thinning)
    wave = 2 * np.pi * found.band.frequency_hz[thin] / (found.speed_mps * 1e3)
    spectra = np.exp(-1j * path_mm[..., None] * wave).astype(np.complex64) / path_mm[..., None].astype(np.float32)
    return spectra * (found.channels.response * found.channels.filter)[:, thin]


def fit_plane(found: Sounding, heights: PingHeights, tilted: bool) -> Plane:
    """Plane through the heights of some pings, least absolute deviations weighted by likeness.

    Notes
    -----
    A ping's height is its perpendicular distance to the plate taken off the array's height, so it is turned
    back with the slope found. Fewer than four pings, or pings in a row, give a horizontal plane.
    """
    centre = np.array([found.apertures[int(k)].elements_mm[0] for k in heights.which])
    middle = centre[:, :2].mean(axis=0)
    offset = centre[:, :2] - middle
    level = _weighted_median(heights.height_mm, heights.likeness)
    slope = np.zeros(2)
    spread = np.linalg.svd(offset, compute_uv=False) if tilted and len(offset) >= 4 else np.zeros(2)
    if tilted and spread[-1] > 5.0:
        columns = np.column_stack((np.ones(len(offset)), offset))
        distance = centre[:, 2] - heights.height_mm
        solution = np.array([level, 0.0, 0.0])
        for _ in range(FIT_ROUNDS):
            target = centre[:, 2] - distance * np.sqrt(1 + solution[1] ** 2 + solution[2] ** 2)
            weight = heights.likeness.clip(0.05) / (np.abs(target - columns @ solution) + 0.3)
            normal = columns.T @ (weight[:, None] * columns)
            solution = np.linalg.solve(normal, columns.T @ (weight * target))
            solution[1:] = solution[1:].clip(-STEEPEST, STEEPEST)
        level, slope = float(solution[0]), solution[1:]
    return Plane(float(middle[0]), float(middle[1]), level, float(slope[0]), float(slope[1]))


def _weighted_median(values: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    order = np.argsort(values, kind="stable")
    share = np.cumsum(weights[order].clip(1e-3))
    return float(values[order[int(np.searchsorted(share, 0.5 * share[-1]))]])
