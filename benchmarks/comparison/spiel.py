"""Figures of the localiser on real recordings: its error beside usual ways, its stated sigma, what the data permit."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from echolume_processing.ultrasonic.arrival import ARRIVAL_STEP, arrival_tables, crests
from echolume_processing.ultrasonic.localise import Localiser, expected, grid_around, localise, paths_mm, search_grid
from echolume_processing.ultrasonic.localise_calibrate import calibrate, coarse_delays
from echolume_processing.ultrasonic.localise_score import CHI2_90, sigma_mm
from echolume_processing.ultrasonic.recordings import BLIND_SAMPLES, Recordings, load_recordings
from echolume_processing.ultrasonic.setups import setup_of

DATA = Path(os.environ.get("ECHOLUME_DATA", Path(__file__).parents[3] / "shared" / "data"))
ECHOES = DATA / "spiel-echoes" / "echoes.npz"
SPEED_MPS = 343.2
BLOCKS = 5
NEIGHBOURS = 3

TARGETS: Mapping[str, tuple[float, float]] = {"spiel_median_mm": (20, 12), "spiel_p90_mm": (45, 30)}
"""What is asked at least, and the aim."""


def added(recordings: Recordings) -> np.ndarray:
    """Root of the power that the target adds, (recordings, channels, samples)."""
    power = np.sqrt(np.maximum(recordings.frames**2 - recordings.backgrounds**2, 0.0))
    power[:, :, :BLIND_SAMPLES] = 0.0
    return power


def per_mm(recordings: Recordings) -> float:
    """Samples per mm of path."""
    return recordings.sample_rate_hz / (1e3 * SPEED_MPS)


def back_projection(seen: Recordings, unseen: Recordings) -> np.ndarray:
    """The place where the sum of the channels' normalised envelopes is largest, (recordings, 3)."""
    grid = search_grid(side_step_mm=5.0, depth_step_mm=5.0)
    at = paths_mm(grid, seen.elements_mm) * per_mm(seen) + coarse_delays(seen, SPEED_MPS)
    envelopes = added(unseen)
    envelopes /= np.maximum(envelopes.max(axis=2, keepdims=True), 1.0)
    samples = np.arange(envelopes.shape[2])
    return np.array(
        [grid[np.argmax(sum(np.interp(at[:, c], samples, row) for c, row in enumerate(rows)))] for rows in envelopes]
    )


def ellipsoids(seen: Recordings, unseen: Recordings) -> np.ndarray:
    """Least squares through the paths of each channel's largest peak, (recordings, 3)."""
    delays = coarse_delays(seen, SPEED_MPS)
    envelopes = added(unseen)
    top = np.clip(envelopes.argmax(axis=2), 1, envelopes.shape[2] - 2)
    left, peak, right = (np.take_along_axis(envelopes, (top + k)[:, :, None], axis=2)[:, :, 0] for k in (-1, 0, 1))
    bend = left - 2 * peak + right
    paths = (top + np.where(bend < 0, 0.5 * (left - right) / np.where(bend < 0, bend, -1), 0) - delays) / per_mm(seen)

    def place(path: np.ndarray) -> np.ndarray:
        start = np.array([0.0, 0.0, 0.5 * np.median(path)])
        bounds = ([-110, -110, 60], [110, 110, 260])
        start = np.clip(start, [-109, -109, 61], [109, 109, 259])
        return least_squares(
            lambda x: paths_mm(x[None], seen.elements_mm)[0] - path, start, bounds=bounds, loss="soft_l1", f_scale=5.0
        ).x

    return np.array([place(path) for path in paths])


def neighbours(seen: Recordings, unseen: Recordings) -> np.ndarray:
    """Mean place of the recordings with the nearest envelopes; it has met these places, (recordings, 3)."""
    known, asked = (added(r)[:, :, : 3 * BLIND_SAMPLES].reshape(len(r.frames), -1) for r in (seen, unseen))
    far = np.linalg.norm(asked[:, None] - known, axis=2)
    return seen.target_mm[np.argsort(far, axis=1)[:, :NEIGHBOURS]].mean(axis=1)


def blocks_of(target_mm: np.ndarray) -> np.ndarray:
    """Block of each recording: columns of places that share x and y stay together, (recordings,)."""
    columns, index = np.unique(np.round(target_mm[:, :2]), axis=0, return_inverse=True)
    return np.random.default_rng(0).permutation(len(columns))[index.ravel()] % BLOCKS


def cross_validated(seen: Recordings) -> tuple[np.ndarray, np.ndarray]:
    """Error (recordings, 3) and its square over the stated covariance (recordings,), places never met before."""
    block = blocks_of(seen.target_mm)
    away = np.empty((len(block), 3))
    squares = np.empty(len(block))
    for k in range(BLOCKS):
        asked = seen.chosen(block == k)
        met = seen.chosen(block != k)
        found = localise(calibrate(met), asked.frames, asked.backgrounds, grid_around(met.target_mm))
        away[block == k] = found.place_mm - asked.target_mm
        inverse = np.linalg.inv(found.covariance_mm2)
        squares[block == k] = np.einsum("ri,rij,rj->r", away[block == k], inverse, away[block == k])
    return away, squares


def permitted(localiser: Localiser, seen: Recordings, asked_mm: np.ndarray) -> np.ndarray:
    """3D errors that the scatter of the seen arrivals causes at the asked places, if nothing else did, (draws,).

    The scatter of the crests around the calibrated geometry, by channel and depth (robust: 1.48 of the median), goes
    through the paths' derivatives to the Cramer-Rao bound of a place; levels and search box are left out.
    """
    setup = setup_of(seen.backgrounds, localiser.setups)
    at, _ = expected(localiser, seen.target_mm, setup)
    around = at[:, :, None] + np.arange(-4.0, 4.0, ARRIVAL_STEP)
    crest, _ = crests(arrival_tables(seen.frames, seen.backgrounds, localiser.pulses, around, localiser.model), around)
    rng = np.random.default_rng(0)
    draws: list[np.ndarray] = []
    for place in asked_mm:
        near = np.abs(seen.target_mm[:, 2] - place[2]) <= 20
        sigma = 1.4826 * np.median(np.abs(crest - at)[near], axis=0) / per_mm(seen)
        answer = place + localiser.offset_mm
        back = answer - seen.elements_mm
        slope = answer / np.linalg.norm(answer) + back / np.linalg.norm(back, axis=1)[:, None]
        covariance = np.linalg.inv((slope / sigma[:, None] ** 2).T @ slope)
        draws.append(np.linalg.norm(rng.multivariate_normal(np.zeros(3), covariance, 20), axis=1))
    return np.concatenate(draws)


def told(name: str, error: np.ndarray) -> None:
    """Print a row of the table."""
    print(f"{name:44}{np.median(error):9.1f}{np.mean(error):9.1f}{np.percentile(error, 90):9.1f}")


def spiel_rows() -> dict[str, float]:
    """Calibrated on even-numbered recordings; 3D error on the odd ones, printed beside peers and what is asked."""
    if not ECHOES.is_file():
        print(f"\nno real recordings at {ECHOES}; set ECHOLUME_DATA")
        return {}
    recordings = load_recordings(ECHOES)
    even = np.arange(len(recordings.frames)) % 2 == 0
    seen, unseen = recordings.chosen(even), recordings.chosen(~even)
    began_s = time.perf_counter()
    localiser = calibrate(seen)
    middle_s = time.perf_counter()
    found = localise(localiser, unseen.frames, unseen.backgrounds, grid_around(seen.target_mm))
    ended_s = time.perf_counter()
    away = found.place_mm - unseen.target_mm
    error = np.linalg.norm(away, axis=1)
    squares = np.einsum("ri,rij,rj->r", away, np.linalg.inv(found.covariance_mm2), away)
    print(f"\nreal recordings, 1 + 3, envelopes: 3D error in mm\n{'':44}{'median':>9}{'mean':>9}{'p90':>9}")
    told("echolume", error)
    for depth in np.unique(unseen.target_mm[:, 2]):
        told(f"  at {depth:.0f} mm", error[unseen.target_mm[:, 2] == depth])
    told("back-projection of envelopes", np.linalg.norm(back_projection(seen, unseen) - unseen.target_mm, axis=1))
    told("ellipsoids, least squares", np.linalg.norm(ellipsoids(seen, unseen) - unseen.target_mm, axis=1))
    told(
        f"{NEIGHBOURS} nearest neighbours, places met before",
        np.linalg.norm(neighbours(seen, unseen) - unseen.target_mm, axis=1),
    )
    held, held_squares = cross_validated(seen)
    told("echolume, even ones, places never met", np.linalg.norm(held, axis=1))
    told("Cramer-Rao of the even ones' arrivals", permitted(localiser, seen, unseen.target_mm))
    print(
        f"stated: sigma {np.median(sigma_mm(found)):.1f} mm; inside the 90 % ellipsoid {np.mean(squares < CHI2_90):.2f}"
        f" (even ones, places never met: {np.mean(held_squares < CHI2_90):.2f}); median of the squared error over the"
        f" covariance {np.median(squares):.2f} (2.37)\n"
        f"channels that hear the target: {np.mean(found.heard.sum(axis=1)):.2f} of {found.heard.shape[1]}; calibration"
        f" {middle_s - began_s:.1f} s, {1e3 * (ended_s - middle_s) / len(error):.0f} ms a recording"
    )
    figures = {"spiel_median_mm": float(np.median(error)), "spiel_p90_mm": float(np.percentile(error, 90))}
    print(f"\n{'spiel':28}{'measured':>10}{'at least':>10}{'aim':>8}")
    for key, (bar, aim) in TARGETS.items():
        print(f"{key:28}{figures[key]:10.3f}{bar:10g}{aim:8g}")
    return figures


if __name__ == "__main__":
    spiel_rows()
