"""How often whole cycles, and kinds of surface across poses, come out right."""

from __future__ import annotations

import time

import numpy as np

from comparison.contact_peers import images_of
from echolume_messages.geometry import rotation_from_vector, transform
from echolume_processing.ultrasonic.cycles import resolve_cycles
from echolume_processing.ultrasonic.primitives import Primitive, SurfaceKind
from echolume_processing.ultrasonic.surface_fit import scan_of
from echolume_processing.ultrasonic.surfaces import classify

GRID = np.array([(x, y, 0.0) for y in (-1, 0, 1) for x in (-1, 0, 1) if (x, y) != (0, 0)])
PITCH_MM = 37.5
WAVELENGTH_MM = 8.58
"""Of path: one cycle slip."""
PHASE_SIGMA_MM = {10: 0.108, 20: 0.024, 30: 0.006}
ENVELOPE_SIGMA_MM = {10: 3.74, 20: 1.26, 30: 0.40}
"""Of path, twice that of range, by SNR in dB: matched filter with phase (20 dB: 0.012 mm of range), and without."""


def cycle_rows(pings: int = 200) -> dict[str, float]:
    """How often the whole cycles of all channels come out right."""
    rng = np.random.default_rng(4)
    receivers = PITCH_MM * GRID
    figures: dict[str, float] = {}
    print("\nWhole cycles of eight channels: pings without a slip; all right, resolved, wrong among the resolved")
    cases = [(db, PHASE_SIGMA_MM[db], ENVELOPE_SIGMA_MM[db]) for db in (10, 20)]
    cases += [(10, sigma, ENVELOPE_SIGMA_MM[10]) for sigma in (0.3, 0.5, 1.0)]
    for snr_db, sigma, envelope_sigma in cases:
        clean = right = resolved = wrong = 0
        for image in images_of(rng, pings):
            truth = np.linalg.norm(image - receivers, axis=1)
            phase, envelope = truth + rng.normal(0, sigma, 8), truth + rng.normal(0, envelope_sigma, 8)
            slips = np.rint((envelope - phase) / WAVELENGTH_MM).astype(int)
            found = resolve_cycles(
                receivers,
                phase + WAVELENGTH_MM * slips,
                np.full(8, sigma),
                WAVELENGTH_MM,
                envelope,
                np.full(8, envelope_sigma),
            )
            hit = np.array_equal(found.cycles, slips)
            clean, right = clean + (not slips.any()), right + hit
            resolved, wrong = resolved + found.resolved, wrong + (found.resolved and not hit)
        print(
            f"{snr_db} dB, path sigma {sigma:.3f} mm by phase, {envelope_sigma:.2f} by envelope:"
            f"{100 * clean / pings:7.1f} %{100 * right / pings:7.1f} %"
            f"{100 * resolved / pings:7.1f} %{100 * wrong / max(resolved, 1):7.1f} %"
        )
        figures.setdefault(f"cycles_right_pct_{snr_db}db", 100 * right / pings)
        figures.setdefault(f"cycles_clean_pct_{snr_db}db", 100 * clean / pings)
    return figures


def primitive_of(kind: SurfaceKind, rng: np.random.Generator) -> Primitive:
    """One at random near the origin."""
    if kind == SurfaceKind.PLANE:
        normal = np.array([*rng.normal(0, 0.1, 2), 1.0])
        return Primitive(kind, np.zeros(3), normal / np.linalg.norm(normal))
    position, radius = rng.uniform(-10, 10, 3), float(rng.uniform(10, 60))
    if kind in (SurfaceKind.POINT, SurfaceKind.SPHERE):
        return Primitive(kind, position, np.zeros(3), radius if kind == SurfaceKind.SPHERE else 0.0)
    turn = rng.uniform(0, np.pi)
    along = np.array([np.cos(turn), np.sin(turn), rng.normal(0, 0.1)])
    return Primitive(kind, position, along / np.linalg.norm(along), radius if kind == SurfaceKind.CYLINDER else 0.0)


def surface_rows(scans: int = 8) -> dict[str, float]:
    """Kinds of surface told from 1, 2 and 4 poses within 40 mm and some 6 degrees, path sigma 0.05 mm."""
    rng = np.random.default_rng(6)
    receivers, down = PITCH_MM * GRID, rotation_from_vector(np.array([np.pi, 0, 0]))
    figures: dict[str, float] = {}
    print("\nKinds told right, and left ambiguous, in %; processor time of one")
    for poses in (1, 2, 4):
        told: list[bool] = []
        began_s = time.thread_time()
        for kind in [k for k in SurfaceKind if k]:
            right = ambiguous = 0
            for _ in range(scans):
                turns = [rotation_from_vector(np.array([*rng.normal(0, 0.1, 2), rng.normal()])) for _ in range(poses)]
                places = [np.array([*rng.uniform(-40, 40, 2), rng.uniform(180, 250)]) for _ in range(poses)]
                at = np.array([transform(down @ t, p) for t, p in zip(turns, places, strict=True)])
                ones = np.ones((poses, 8))
                rows = scan_of(at, receivers, ones, ones)
                paths = primitive_of(kind, rng).paths_mm(rows.emitter_mm, rows.receiver_mm).reshape(ones.shape)
                found = classify(at, receivers, paths + rng.normal(0, 0.05, ones.shape), 0.05 * ones)
                right, ambiguous = right + (found.kind == kind), ambiguous + found.ambiguous
                told.append(found.kind == kind and not found.ambiguous)
            line = f"{poses} poses, {kind.name.lower():10}{100 * right / scans:6.0f}{100 * ambiguous / scans:6.0f}"
            print(line)
        print(f"{1e3 * (time.thread_time() - began_s) / len(told):.0f} ms")
        figures[f"surfaces_told_pct_{poses}_poses"] = 100 * float(np.mean(told))
    return figures
