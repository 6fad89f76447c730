"""Self-registration: the array's place and the speed of sound, from the echoes of the surface that light saw."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from echolume_processing.hybrid.alignment import at_assumed_speed, equations, likeness, smooth_gain, solve
from echolume_processing.hybrid.model import MOVES, Registration
from echolume_processing.hybrid.predict import Aperture
from echolume_processing.hybrid.setup_error import DRIFT, NAMES, POSE, SHIFTS, SPEED, displacements, faster, moved
from echolume_processing.hybrid.sounding import Sounding, Spectra
from echolume_processing.hybrid.surface import Surface

SEARCH_MM = 2.1
"""The first look goes this far up and down,"""
SLIP = 0.28
"""and no further than this share of a wave: at half a wave lies the next peak."""
STEP_MM = 0.05
BEST_SHARE = 1 / 3
"""So many pings, the best ones, give the channels' gains; the others may look at what light cannot see."""
ALIKE = 0.16
"""A ping agrees with its prediction if that leaves less than this share of its energy, -8 dB."""
LEAST_PINGS = 12
"""Fewer agreeing pings than this do not register a scan,"""
LEAST_SHARE = 0.05
"""nor a smaller share of all pings: among many, some agree by chance."""
TOO_FAR = 3.0
"""A move of so many sigmas of what a set-up may be off is none: something else was taken for the surface."""
ROUNDS = 4
SURVEYED = 120
"""So many pings are enough to find shifts, tilts and speed."""
SHIFT_MM = 0.5
"""Step of the derivative by x and y."""
ANEW_MM = 0.2
"""An element that moved further than this gets its echoes predicted anew; smaller moves only delay them."""
STRETCH = 1e-4
"""Step of the derivative by the speed of sound."""
COARSE_ROUNDS = 20


@dataclass(frozen=True)
class _View:
    """Some pings at the present state of the set-up."""

    which: NDArray[np.int64]
    sideways: NDArray[np.complex64] | None
    """Derivative (2, pings, receivers, bins) of the spectra by x and y; None where nobody has looked."""
    at: NDArray[np.float64]
    """Errors that those were taken at."""


def register(
    found: Sounding, predicted: Spectra, scene: Surface | None = None
) -> tuple[Sounding, Spectra, Registration]:
    """Bring the set-up, and with it the predictions of all pings, onto the measured echoes.

    Parameters
    ----------
    found
        All pings of the scan.
    predicted : (pings, receivers, bins) complex64
        Their echoes as the surface gives them, from the calibrated set-up.
    scene
        The surface, to find shifts along it and to predict anew after a large move; without it only what delays
        the echoes of level ground is found: height, tilts, speed of sound and its drift.

    Returns
    -------
    tuple
        The sounding with its apertures moved, its measured echoes brought to the assumed speed of sound and its
        channels' gains corrected; the corrected predictions; and what was moved.

    Notes
    -----
    Pings that the surface explains (`ALIKE`) vote, by their waveforms: the prediction is linear in the ten errors of
    the set-up, solved by Gauss-Newton with Huber's weights. What the scene does not determine stays as calibrated. It
    refuses if too few pings agree, as over glass alone or where light saw nothing of what sound hears. A glass plate
    less than `SEARCH_MM` above all of the bench cannot be told from an array that sits lower.
    """
    problem = _Problem(found, predicted)
    value, agree = problem.first_look()
    if (reason := _too_few(agree)) is not None:
        return found, predicted, Registration(0.0, found.air_mps, refused=reason)
    before = problem.residual(np.zeros(len(NAMES)))
    view = problem.view(agree, scene)
    value, sigma, determined = problem.solve(view, value)
    if scene is not None and problem.reach_mm(value) > ANEW_MM:
        problem = problem.predicted_anew(scene, value)
        value, sigma, determined = problem.solve(view, value)
    residual = problem.residual(value)
    if (reason := _too_few(residual < ALIKE) or _too_far(value, found.prior)) is not None:
        return found, predicted, Registration(0.0, found.air_mps, refused=reason)
    settled, corrected, good = problem.settled(value, np.where(determined, sigma, found.prior))
    after = settled.residual(corrected[good], good)
    told = np.append(value[:SPEED], value[SPEED:] * found.speed_mps * np.array([1.0, 2.0]))
    spread = np.append(sigma[:SPEED], sigma[SPEED:] * found.speed_mps * np.array([1.0, 2.0]))
    return (
        settled,
        corrected,
        Registration(
            **dict(zip(MOVES, told.tolist(), strict=True)),
            speed_of_sound_mps=found.air_mps * (1 + float(value[SPEED])),
            pings=int((residual < ALIKE).sum()),
            residual_db=_db(after),
            before_db=_db(before[good]),
            sigma=dict(zip(MOVES, spread.tolist(), strict=True)),
            undetermined=tuple(name for name, known in zip(MOVES, determined, strict=True) if not known),
        ),
    )


def _db(share: NDArray[np.float64]) -> float:
    return float(10 * np.log10(np.median(share)))


def _too_few(agree: NDArray[np.bool_]) -> str | None:
    least = max(LEAST_PINGS, int(np.ceil(LEAST_SHARE * agree.size)))
    if agree.sum() >= least:
        return None
    return f"{int(agree.sum())} of {agree.size} pings hear the surface that light saw, expected at least {least}"


def _too_far(value: NDArray[np.float64], prior: NDArray[np.float64]) -> str | None:
    for name, one, sigma in zip(MOVES, value, prior, strict=True):
        if abs(one) > TOO_FAR * sigma:
            most = TOO_FAR * sigma
            return f"the echoes would move {name} by {one:+.3g}, and a set-up is not off by more than {most:.2g}"
    return None


class _Problem:
    """A scan beside predictions that were made from where the set-up was `at`."""

    def __init__(self, found: Sounding, base: Spectra, at: NDArray[np.float64] | None = None) -> None:
        self._found, self._base = found, base
        self._at = np.zeros(len(NAMES)) if at is None else at
        elements_mm = np.array([a.elements_mm for a in found.apertures])
        move = displacements(elements_mm)
        self._up = move[:, :, :1, 2] + move[:, :, 1:, 2]  # (POSE, pings, receivers): by what the path is longer
        self._aside = move[:, :, 0, :2]  # (POSE, pings, 2)
        self._move = move
        self._response = found.channels.response * found.channels.filter
        self._wave = (2 * np.pi * found.band.frequency_hz / (found.speed_mps * 1e3)).astype(np.float32)

    def first_look(self) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Height and tilts through the shifts that fit each ping best, and which pings agree after that."""
        band = self._found.band
        search_mm = min(SEARCH_MM, SLIP * 2e3 * self._found.speed_mps / (band.low_hz + band.high_hz))
        shifts_mm = np.arange(-search_mm, search_mm + STEP_MM / 2, STEP_MM)
        turns = np.exp(-2j * self._wave * shifts_mm[:, None]).astype(np.complex64)
        like = likeness(self._found.gate, self._found.measured, self._base, turns)
        every = np.arange(len(like))
        best = like.argmax(axis=1)
        peak = like[every, best]
        good = peak >= np.quantile(peak, 1 - BEST_SHARE)
        columns = 0.5 * self._up[:3].mean(axis=2).T  # (pings, 3)
        fit = _plane(columns[good], shifts_mm[best[good]])
        place = np.rint((columns @ fit - shifts_mm[0]) / STEP_MM).astype(np.int64)
        inside = (place >= 0) & (place < shifts_mm.size)
        there = np.where(inside, like[every, place.clip(0, shifts_mm.size - 1)], 0.0)
        value = np.zeros(len(NAMES))
        value[:3] = fit
        return value, (there > 0) & (1 - there**2 < 2 * ALIKE)

    def view(self, agree: NDArray[np.bool_], scene: Surface | None) -> _View:
        """The pings that vote, spread over the scan; with a scene, how their echoes change along it."""
        which = np.nonzero(agree)[0]
        which = which[np.linspace(0, which.size - 1, min(SURVEYED, which.size)).astype(np.int64)]
        if scene is None:
            return _View(which, None, self._at)
        found, sideways = self._found, list[NDArray[np.complex64]]()
        for axis in range(2):
            step_mm = np.zeros(3)
            step_mm[axis] = SHIFT_MM
            beside = tuple(Aperture(a.elements_mm + step_mm, a.axis) for a in found.apertures)
            there = replace(found, apertures=beside).predict(scene, which)
            sideways.append((there - self._base[which]) / np.float32(SHIFT_MM))
        return _View(which, np.stack(sideways), self._at)

    def solve(
        self, view: _View, value: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        """Gauss-Newton from a first guess: value, sigma and which are determined."""
        found, which = self._found, view.which
        free = np.ones(len(NAMES), dtype=np.bool_)
        if view.sideways is None:
            free[list(SHIFTS)] = False
        if not np.ptp(found.order[which]):
            free[DRIFT] = False
        sigma, determined = found.prior, free
        for _ in range(ROUNDS):
            measured = self._measured(value, which)
            spectra = self._predicted(value, which)
            if view.sideways is not None:
                aside = np.einsum("akcf,ka->kcf", view.sideways, self._aside_of(value, which))
                spectra = spectra + self._delayed(aside, value - view.at, which)
            predicted = found.gate.waveform(spectra.astype(np.complex64))
            some = equations(measured, predicted, self._columns(view, spectra, value))
            alike = some.residual < 2 * ALIKE
            weight = np.where(alike, 1 / (some.residual + np.median(some.residual)), 0.0)
            # linearised about 0, so that the prior stays where it is
            about_zero = replace(some, right=some.right + np.einsum("kab,b->ka", some.normal, value))
            answer = solve(about_zero, weight, found.prior, free)
            value, sigma, determined = answer.value, answer.sigma, answer.determined
        return value, sigma, determined

    def _columns(
        self, view: _View, spectra: NDArray[np.complex64], value: NDArray[np.float64]
    ) -> NDArray[np.complex64]:
        """Derivative of the predicted waveforms by each error, (errors, pings, receivers, samples)."""
        gate, which = self._found.gate, view.which
        longer = gate.waveform((spectra * (-1j * self._wave)).astype(np.complex64))
        out = [self._up[j, which][..., None].astype(np.float32) * longer for j in range(POSE)]
        if view.sideways is not None:
            aside = [gate.waveform(self._delayed(view.sideways[a], value - view.at, which)) for a in range(2)]
            for j in range(POSE):
                for a in range(2):
                    out[j] = out[j] + self._aside[j, which, a][:, None, None].astype(np.float32) * aside[a]
        predicted = gate.waveform(spectra.astype(np.complex64))
        step, response = np.full(which.size, STRETCH), self._response
        later = at_assumed_speed(gate, response, predicted, step)
        sooner = (at_assumed_speed(gate, response, predicted, -step) - later) / np.float32(2 * STRETCH)
        drifting = self._found.order[which][:, None, None].astype(np.float32) * sooner
        return np.stack([*out, sooner, drifting])

    def _measured(self, value: NDArray[np.float64], which: NDArray[np.int64]) -> NDArray[np.complex64]:
        found = self._found
        share = faster(value, found.order[which])
        return at_assumed_speed(found.gate, self._response, found.measured[which], share)

    def _predicted(self, value: NDArray[np.float64], which: NDArray[np.int64]) -> NDArray[np.complex64]:
        return self._delayed(self._base[which], value - self._at, which)

    def _delayed(
        self, spectra: NDArray[np.complex64], since: NDArray[np.float64], which: NDArray[np.int64]
    ) -> NDArray[np.complex64]:
        """Spectra later by what the set-up has moved by since they were predicted."""
        longer_mm = np.tensordot(since[:POSE], self._up[:, which], axes=1)
        return (spectra * np.exp(-1j * longer_mm[..., None].astype(np.float32) * self._wave)).astype(np.complex64)

    def _aside_of(self, value: NDArray[np.float64], which: NDArray[np.int64]) -> NDArray[np.float64]:
        """How far each ping lies beside the place that it was predicted from, (pings, 2)."""
        return np.tensordot((value - self._at)[:POSE], self._aside[:, which], axes=1)

    def residual(self, value: NDArray[np.float64]) -> NDArray[np.float64]:
        """What each ping's prediction leaves of its energy, the channels' levels being free."""
        every = np.arange(len(self._base))
        predicted = self._found.gate.waveform(self._predicted(value, every))
        none = np.zeros((0, *predicted.shape), dtype=np.complex64)
        return equations(self._measured(value, every), predicted, none).residual

    def reach_mm(self, value: NDArray[np.float64]) -> float:
        """How far the element that moved most is from where the echoes were predicted."""
        shift = np.tensordot((value - self._at)[:POSE], self._move, axes=1)
        return float(np.linalg.norm(shift, axis=2).max())

    def predicted_anew(self, scene: Surface, value: NDArray[np.float64]) -> _Problem:
        """The same scan beside predictions from where the set-up is now."""
        found = self._found
        there = replace(found, apertures=moved(found.apertures, value))
        return _Problem(found, there.predict(scene, np.arange(len(found.apertures))), value)

    def settled(
        self, value: NDArray[np.float64], prior: NDArray[np.float64]
    ) -> tuple[Sounding, Spectra, NDArray[np.int64]]:
        """Everything moved, gains fitted on the best pings; and which those are."""
        found, every = self._found, np.arange(len(self._base))
        measured, predicted = self._measured(value, every), self._predicted(value, every)
        residual = self.residual(value)
        good = np.nonzero(residual <= np.quantile(residual, BEST_SHARE))[0]
        gain = smooth_gain(found.gate, predicted[good], measured[good]).astype(np.complex64)
        settled = replace(
            found,
            channels=replace(found.channels, response=found.channels.response * gain),
            apertures=moved(found.apertures, value),
            measured=measured,
            energy=(np.abs(measured).astype(np.float64) ** 2).sum(axis=(1, 2)),
            prior=prior,
        )
        return settled, predicted * gain, good


def _plane(columns: NDArray[np.float64], shifts_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Height and tilts (3,) through shifts of which many may be wrong: Tukey's biweight from the median on."""
    fit = np.array([float(np.median(shifts_mm)), 0.0, 0.0])
    scale = np.array([1.0, 100.0, 100.0])
    for round_number in range(COARSE_ROUNDS):
        left = shifts_mm - columns @ fit
        spread_mm = max(0.1, 1.4826 * float(np.median(np.abs(left))), 0.6 * 0.8**round_number)
        weight = np.clip(1 - (left / (3 * spread_mm)) ** 2, 0, None) ** 2
        scaled = columns / scale
        normal = scaled.T @ (weight[:, None] * scaled) + 1e-3 * np.eye(3)
        fit = np.linalg.solve(normal, scaled.T @ (weight * shifts_mm)) / scale
    return fit
