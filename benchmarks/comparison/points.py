"""Figures from a frame pair to points: speed beside the usual ways, wrong points in clutter, honest sigmas."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import msgspec
import numpy as np
from scipy.spatial import cKDTree

from echolume_drivers.emulated.optics import CameraTruth, OpticalTruth, optical_truth
from echolume_drivers.emulated.scene import Scene, demo, matte, plate
from echolume_drivers.emulated.stripe_image import render_stripe, true_stripe
from echolume_messages.calibration import CameraCalibration, LaserCalibration
from echolume_messages.types import OPTICAL_POINT, OpticalSource
from echolume_processing.optical import covariance, triangulate
from echolume_processing.optical.camera import Camera
from echolume_processing.optical.candidates import Candidates, candidates_of, view_of
from echolume_processing.optical.correspond import walk
from echolume_processing.optical.pipeline import OpticalPipeline, OpticalSettings
from echolume_processing.optical.stripe import extract

EXPOSURE_S = 4e-3
WRONG_MM = 1.0
"""A point further than this from the lit surface is wrong, and a row without a point as near is missing."""
BLOBS, HOT_PIXELS = 12, 300
SIDES = ("left", "right")
POINTS = 20_000
IMAGE_NOISE_PX = 0.1
PAIRS = 9
"""Frame pairs that take turns: more than the processor's second cache holds, as in operation."""
GUIDE_SIGMA_MM, CAMERA_SIGMA_PX = 0.01, 0.01
PLANE_SIGMAS = (0.015, 5e-5, 1e-4, 2e-4)
"""Errors that the emulated scans get, and that the covariances are told of: of the plane's position, its advance along
the guide, and its slopes in y and z."""
EDGE_ROWS, EDGE_MM = 6, 1.0

TARGETS: Mapping[str, tuple[float, float]] = {
    "wrong_points_pct": (0.3, 0.1),
    "complete_pct": (95, 97),
    "st_vs_cv2": (30, 40),
    "st_eigh_diff_mm": (1e-4, 1e-4),
    "at_vs_solve": (80, 100),
    "match_vs_nxn": (1000, 2500),
    "pair_x_floor": (15, 9),
    "optical_nees": (1.25, 1.1),
}
"""What is asked at least, and the aim."""


def camera_of(truth: CameraTruth) -> CameraCalibration:
    """The emulated camera as a perfect calibration would find it."""
    return CameraCalibration(
        width_px=truth.width_px,
        height_px=truth.height_px,
        camera_matrix=truth.matrix.tolist(),
        distortion=truth.distortion.tolist(),
        camera_from_rig=truth.camera_from_rig.tolist(),
        rms_px=0.04,
    )


def laser_of(truth: OpticalTruth) -> LaserCalibration:
    """The emulated laser plane as a perfect calibration would find it."""
    n, g = truth.laser_normal.tolist(), truth.guide_direction.tolist()
    return LaserCalibration(
        normal=(n[0], n[1], n[2]), offset_mm=truth.laser_offset_mm, guide_direction=(g[0], g[1], g[2]), rms_mm=0.02
    )


def clutter(frame: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The frame with a dozen glints, a secondary stripe of a third to two thirds of the rows, and hot pixels."""
    out = frame.astype(np.float64)
    rows, columns = frame.shape
    yy, xx = np.mgrid[-25:26, -25:26]
    for _ in range(BLOBS):
        y, x = rng.integers(30, rows - 30), rng.integers(30, columns - 30)
        size = rng.uniform(2, 7)
        out[y - 25 : y + 26, x - 25 : x + 26] += rng.uniform(60, 220) * np.exp(-(xx**2 + yy**2) / (2 * size**2))
    length = rng.integers(rows // 3, 2 * rows // 3)
    row = rng.integers(0, rows - length) + np.arange(length)
    t = np.linspace(-1, 1, length)
    column = rng.uniform(100, columns - 100) + rng.uniform(-80, 80) * t + rng.uniform(-30, 30) * t**2
    away = np.arange(columns) - column[:, None]
    grain = rng.normal(1, 0.15, (length, columns))
    out[row] += rng.uniform(20, 100) * grain * np.exp(-0.5 * (away / rng.uniform(1.6, 1.9)) ** 2)
    out.ravel()[rng.integers(0, out.size, HOT_PIXELS)] = rng.uniform(150, 255, HOT_PIXELS)
    return np.clip(np.rint(out), 0, 255).astype(np.uint8)


@dataclass
class Tally:
    """Counts over many frames."""

    points: int = 0
    wrong: int = 0
    rows: int = 0
    found: int = 0

    @property
    def wrong_pct(self) -> float:
        """Share of the published points that are wrong."""
        return 100 * self.wrong / max(self.points, 1)

    @property
    def complete_pct(self) -> float:
        """Share of the rows with a visible stripe that got a right active point."""
        return 100 * self.found / max(self.rows, 1)


def fronts(scene: Scene, truth: OpticalTruth, x_mm: float) -> np.ndarray:
    """Points (n, 3) of what stands within a millimetre of the laser plane, its walls included.

    Edges of glass and of black things glint: a point on them is right, though the map of light leaves them out.
    """
    y_mm = np.arange(-119.9, 120, 0.2)
    found = []
    for aside_mm in (-1.0, 0.0, 1.0):
        z_mm = np.zeros(len(y_mm))
        for _ in range(2):
            x = truth.plane_offset_mm(x_mm) - truth.laser_normal[1] * y_mm - truth.laser_normal[2] * z_mm + aside_mm
            ix = np.floor((x - scene.x0_mm) / scene.cell_mm).astype(int)
            iy = np.floor((y_mm - scene.y0_mm) / scene.cell_mm).astype(int)
            z_mm = scene.front_mm[iy, np.clip(ix, 0, scene.front_mm.shape[1] - 1)]
        found.append(np.column_stack([x, y_mm, z_mm]))
        for i in np.flatnonzero(np.diff(z_mm)):
            wall_mm = np.arange(min(z_mm[i : i + 2]), max(z_mm[i : i + 2]), 0.2)
            found.append(np.column_stack([np.full_like(wall_mm, x[i]), np.full_like(wall_mm, y_mm[i]), wall_mm]))
    return np.concatenate(found)


def off_mm(points: np.ndarray, lit: cKDTree) -> np.ndarray:
    """Distance along the laser plane of OPTICAL_POINTs (n,) from the nearest piece of the lit surface."""
    return lit.query(np.column_stack([points["y_mm"], points["z_mm"]]))[0]


def score(points: np.ndarray, scene: Scene, truth: OpticalTruth, x_mm: float, tally: Tally) -> dict[str, np.ndarray]:
    """Add one stripe's points to the tally; the wrong ones by source."""
    wrong = {}
    front_mm = fronts(scene, truth, x_mm)
    for side, source in (("left", 2), ("right", 3), ("left", 1)):
        stripe = true_stripe(scene, truth, side, x_mm)
        lit = cKDTree(np.concatenate([stripe.points_mm, front_mm])[:, 1:])
        mine = points[points["source"] == source]
        away = off_mm(mine, lit)
        tally.points += len(mine)
        tally.wrong += int(np.count_nonzero(away > WRONG_MM))
        wrong[f"{side}{source}"] = mine[away > WRONG_MM]
        if source != OpticalSource.STEREO:
            seen = np.isfinite(stripe.rows(truth.camera(side).height_px))
            right = np.zeros(len(seen), dtype=bool)
            right[mine["row"][away <= WRONG_MM]] = True
            tally.rows += int(np.count_nonzero(seen))
            tally.found += int(np.count_nonzero(seen & right))
    return wrong


def pipeline_of(truth: OpticalTruth, settings: OpticalSettings | None = None) -> OpticalPipeline:
    """A pipeline with a perfect calibration."""
    return OpticalPipeline.of(camera_of(truth.left), camera_of(truth.right), laser_of(truth), settings)


def brightest(pair: Sequence[np.ndarray], truth: OpticalTruth, x_mm: float, gated: bool) -> np.ndarray:
    """The usual way: each row's brightest pixel of each camera on the laser plane, at most behind a gate of height."""
    parts = []
    for frame, camera, source in zip(pair, (truth.left, truth.right), (2, 3), strict=True):
        own = Camera(camera.matrix, camera.distortion, camera.camera_from_rig)
        rows = np.flatnonzero(frame.max(axis=1) > 30)
        pixels = own.undistort(np.column_stack([frame[rows].argmax(axis=1), rows]).astype(np.float64))
        plane = triangulate.plane_from_pixel(
            own.centre_mm, own.ray_matrix, truth.laser_normal, truth.plane_offset_mm(x_mm)
        )
        xyz = triangulate.active(plane, pixels)
        keep = (xyz[:, 2] > -8) & (xyz[:, 2] < 80) if gated else np.ones(len(xyz), dtype=bool)
        out = np.zeros(np.count_nonzero(keep), dtype=OPTICAL_POINT)
        out["x_mm"], out["y_mm"], out["z_mm"] = xyz[keep].T
        out["row"], out["source"] = rows[keep], source
        parts.append(out)
    return np.concatenate(parts)


def cluttered(seeds: range, stripes: int, dirty: bool = True, settings: OpticalSettings | None = None) -> list[Tally]:
    """Wrong points and completeness on frames of the demo's scene and its all-matte form: ours, then two usual ways."""
    tallies = [Tally(), Tally(), Tally()]
    for seed in seeds:
        truth = optical_truth(seed)
        pipeline = pipeline_of(truth, settings)
        rng = np.random.default_rng([seed, 77])
        for i, x_mm in enumerate(rng.uniform(-98, 98, stripes)):
            scene = (demo, matte)[i % 2]()
            pair = [render_stripe(scene, truth, side, x_mm, rng, EXPOSURE_S, True) for side in SIDES]
            if dirty:
                pair = [clutter(frame, rng) for frame in pair]
            score(pipeline.process(pair[0], pair[1], x_mm), scene, truth, x_mm, tallies[0])
            if i < 4:
                score(brightest(pair, truth, x_mm, False), scene, truth, x_mm, tallies[1])
                score(brightest(pair, truth, x_mm, True), scene, truth, x_mm, tallies[2])
    return tallies


def clutter_rows(seeds: range = range(1, 7), stripes: int = 16) -> dict[str, float]:
    """Wrong points in clutter, at the completeness that goes with them."""
    ours, bare, gated = cluttered(seeds, stripes)
    clean = cluttered(seeds, 4, dirty=False)[0]
    print(f"\nPoints over {WRONG_MM:.0f} mm off, {BLOBS} blobs, a secondary stripe, {HOT_PIXELS} hot pixels a frame")
    ways = {"echolume": ours, "brightest pixel": bare, "brightest pixel, z gate": gated, "echolume, no clutter": clean}
    for name, tally in ways.items():
        print(f"{name:28}{tally.wrong_pct:8.3f} % wrong of {tally.points:7d}{tally.complete_pct:9.2f} % complete")
    return {"wrong_points_pct": ours.wrong_pct, "complete_pct": ours.complete_pct}


def medians_s(
    ways: Mapping[str, Callable[[int], object]], seconds: float, calls: int = 7, repeats: int = 1
) -> dict[str, float]:
    """Median time of each way; they take turns of so many calls, and are told the number of the turn."""
    spent: dict[str, list[float]] = {name: [] for name in ways}
    for work in ways.values():
        work(0)
    end_s, turn = time.perf_counter() + seconds, 0
    while time.perf_counter() < end_s or turn < calls:
        turn += 1
        for name, work in ways.items():
            for _ in range(repeats):
                began_s = time.perf_counter()
                work(turn)
                spent[name].append(time.perf_counter() - began_s)
    return {name: float(np.median(s)) for name, s in spent.items()}


def triangulation_rows(seconds: float) -> dict[str, float]:
    """ST, AT and both together: time and error."""
    truth, rng = optical_truth(1), np.random.default_rng(1)
    points = rng.uniform([0, -90, 0], [0, 90, 40], (POINTS, 3))
    points[:, 0] = 10.0
    cameras = [Camera(c.matrix, c.distortion, c.camera_from_rig) for c in (truth.left, truth.right)]
    m = cameras[0].projection, cameras[1].projection
    exact = [c.undistort(e.project(points)) for c, e in zip(cameras, (truth.left, truth.right), strict=True)]
    left, right = (np.ascontiguousarray(e + rng.normal(0, [IMAGE_NOISE_PX, 0], e.shape)) for e in exact)
    columns = np.ascontiguousarray(np.concatenate([left, right], axis=1).T)
    left_t, right_t = columns[:2].copy(), columns[2:].copy()
    normal = np.array([1.0, 0.0, 0.0])
    planes = [triangulate.plane_from_pixel(c.centre_mm, c.ray_matrix, normal, 10.0) for c in cameras]
    a = np.empty((POINTS, 3, 3))
    a[:, :, 0], a[:, :, 1], a[:, :2, 2], a[:, 2, 2] = -m[0][:, 1], -m[0][:, 2], left, 1.0
    b = np.broadcast_to(m[0][:, [0, 3]] @ np.array([10.0, 1.0]), (POINTS, 3))[:, :, None]
    sigma = np.full(POINTS, IMAGE_NOISE_PX)

    def joint(plane_mm: float) -> np.ndarray:
        stereo = triangulate.stereo_columns(*m, columns)
        own = covariance.stereo_covariance(*m, stereo, sigma, sigma, 1e-3)
        return covariance.joint(stereo, own, normal, 10.0, plane_mm)[0].T

    def opencv() -> np.ndarray:
        homogeneous = cv2.triangulatePoints(*m, left_t, right_t)
        return (homogeneous[:3] / homogeneous[3]).T

    few = 5_000
    ways: dict[str, Callable[[int], object]] = {
        "ST, echolume": lambda _: triangulate.stereo_columns(*m, columns),
        "ST, cv2.triangulatePoints": lambda _: cv2.triangulatePoints(*m, left_t, right_t),
        "AT, echolume": lambda _: triangulate.active_columns(planes[0], left_t),
        "AT, eq. 3-4 by batched solve": lambda _: triangulate.active_x_plane(m[0], left, 10.0),
        "  its np.linalg.solve alone": lambda _: np.linalg.solve(a, b),
        "ST + AT, plane hard": lambda _: joint(0.0),
    }
    spent = {name: 1e9 * s / POINTS for name, s in medians_s(ways, seconds, repeats=5).items()}
    slow = medians_s({"eigh": lambda _: triangulate.stereo_eigen(*m, left[:few], right[:few])}, 0, 3)["eigh"]
    spent["ST, numpy eigh"] = 1e9 * slow / few
    shifted = triangulate.plane_from_pixel(cameras[0].centre_mm, cameras[0].ray_matrix, normal, 10.05)
    answers = {
        "ST, echolume": triangulate.stereo_columns(*m, columns).T,
        "ST, cv2.triangulatePoints": opencv(),
        "ST, numpy eigh": triangulate.stereo_eigen(*m, left[:few], right[:few]),
        "AT, echolume": triangulate.active_columns(planes[0], left_t).T,
        "AT, eq. 3-4 by batched solve": triangulate.active_x_plane(m[0], left, 10.0),
        "  its np.linalg.solve alone": np.linalg.solve(a, b)[:, [0, 0, 1], 0] * [0, 1, 1] + [10.0, 0, 0],
        "ST + AT, plane hard": joint(0.0),
        "ST + AT, plane soft": joint(PLANE_SIGMAS[0]),
        "AT, plane off by 0.05 mm": triangulate.active(shifted, left),
    }
    print(f"\nTriangulation of {POINTS} points, columns {IMAGE_NOISE_PX} px of noise")
    print(f"{'':29}{'ns a point':>11}{'RMS x mm':>10}{'z mm':>8}")
    for name, answer in answers.items():
        rms = np.sqrt(np.mean((answer - points[: len(answer)]) ** 2, axis=0))
        print(f"{name:29}{spent.get(name, np.nan):11.1f}{rms[0]:10.4f}{rms[2]:8.4f}")
    noisy = [np.ascontiguousarray(e[:few] + rng.normal(0, IMAGE_NOISE_PX, (few, 2))) for e in exact]
    off = np.abs(triangulate.stereo(*m, *noisy) - triangulate.stereo_eigen(*m, *noisy)).max()
    return {
        "st_vs_cv2": spent["ST, cv2.triangulatePoints"] / spent["ST, echolume"],
        "st_eigh_diff_mm": float(off),
        "at_vs_solve": spent["AT, eq. 3-4 by batched solve"] / spent["AT, echolume"],
    }


def _sides(truth: OpticalTruth, pair: Sequence[np.ndarray], x_mm: float) -> list[Candidates]:
    cameras = [Camera(c.matrix, c.distortion, c.camera_from_rig) for c in (truth.left, truth.right)]
    views = view_of(cameras[0], cameras[1]), view_of(cameras[1], cameras[0])
    gates = np.array([-8.0, 80.0, -130.0, 130.0])
    distance_mm = truth.plane_offset_mm(x_mm)
    return [
        candidates_of(extract(pair[i], 1), views[i], views[1 - i], truth.laser_normal, distance_mm, gates)
        for i in (0, 1)
    ]


def match_rows(seconds: float) -> dict[str, float]:
    """Correspondence of two stripes, one candidate a row."""
    truth, rng, x_mm = optical_truth(1), np.random.default_rng(4), -50.0
    pair = [render_stripe(demo(), truth, side, x_mm, rng, EXPOSURE_S, True) for side in SIDES]
    left, right = _sides(truth, pair, x_mm)
    cameras = [Camera(c.matrix, c.distortion, c.camera_from_rig) for c in (truth.left, truth.right)]
    f = view_of(cameras[0], cameras[1]).f_to_other
    expected, other = np.ascontiguousarray(left.expected_px.T), np.ascontiguousarray(right.points_px.T)
    lines = np.column_stack([left.points_px.T, np.ones(len(left.row))]) @ f.T
    ways: dict[str, Callable[[int], object]] = {
        "epipolar walk, echolume": lambda _: walk(left, right, f),
        "N x N, nearest point": lambda _: np.argmin(((expected[:, None] - other[None]) ** 2).sum(axis=2), axis=1),
        "N x N, nearest to the line": lambda _: np.argmin(np.abs(lines[:, :2] @ other.T + lines[:, 2:]), axis=1),
        "k-d tree, nearest point": lambda _: cKDTree(other).query(np.nan_to_num(expected)),
    }
    spent = medians_s(ways, seconds, repeats=5)
    print(f"\nCorrespondence of {len(left.row)} points\n{'':28}{'us':>10}{'times':>8}")
    for name, value in spent.items():
        print(f"{name:28}{1e6 * value:10.1f}{value / spent['epipolar walk, echolume']:8.0f}")
    return {"match_vs_nxn": spent["N x N, nearest point"] / spent["epipolar walk, echolume"]}


def pair_rows(seconds: float) -> dict[str, float]:
    """Both frames of a trigger to filtered points with their sigmas."""
    truth, rng = optical_truth(1), np.random.default_rng(2)
    x_mm = rng.uniform(-90, 90, PAIRS)
    pairs = [[render_stripe(demo(), truth, side, x, rng, EXPOSURE_S, True) for side in SIDES] for x in x_mm]
    pipeline = pipeline_of(truth)
    ways: dict[str, Callable[[int], object]] = {
        "np.max of both, the floor": lambda i: [np.max(f) for f in pairs[i % PAIRS]],
        "copy of both": lambda i: [f.copy() for f in pairs[(i + 3) % PAIRS]],
        "stripe.extract of both": lambda i: [extract(f) for f in pairs[(i + 5) % PAIRS]],
        "frame pair to points": lambda i: pipeline.process(*pairs[(i + 7) % PAIRS], x_mm[(i + 7) % PAIRS]),
    }
    spent = medians_s(ways, seconds)
    floor = spent["np.max of both, the floor"]
    print(f"\nA pair of 1280 x 1024 frames to three point sets with covariances\n{'':28}{'ms':>10}{'x floor':>9}")
    for name, value in spent.items():
        print(f"{name:28}{1e3 * value:10.3f}{value / floor:9.1f}")
    return {"pair_x_floor": spent["frame pair to points"] / floor}


def _moved(camera: CameraCalibration, rng: np.random.Generator) -> CameraCalibration:
    """A calibration that is wrong by as much as its covariance says."""
    rows = [list(row) for row in camera.camera_matrix]
    rows[0][2] += rng.normal(0, CAMERA_SIGMA_PX)
    rows[1][2] += rng.normal(0, CAMERA_SIGMA_PX)
    return msgspec.structs.replace(camera, camera_matrix=rows)


def _tilted(truth: OpticalTruth, rng: np.random.Generator) -> LaserCalibration:
    """A laser plane that is wrong by as much as its covariance says."""
    exact = laser_of(truth)
    n = np.array(exact.normal)
    along = float(n @ np.array(exact.guide_direction))
    off, advance, slope_y, slope_z = rng.normal(0, PLANE_SIGMAS)
    moved = n - np.array([0.0, slope_y, slope_z])
    size = float(np.linalg.norm(moved))
    guide = (along + advance) / size * moved / size
    return msgspec.structs.replace(
        exact,
        normal=tuple((moved / size).tolist()),
        offset_mm=(exact.offset_mm + off) / size,
        guide_direction=tuple(guide.tolist()),
        plane_covariance=np.diag(np.square(PLANE_SIGMAS)).tolist(),
    )


def true_points(scene: Scene, truth: OpticalTruth, side: str, x_mm: float) -> np.ndarray:
    """The lit point (rows, 3) of each image row; nan where there is none, or near an edge."""
    camera = truth.camera(side)
    own = Camera(camera.matrix, camera.distortion, camera.camera_from_rig)
    column = true_stripe(scene, truth, side, x_mm).rows(camera.height_px)
    pixels = own.undistort(np.column_stack([column, np.arange(camera.height_px, dtype=np.float64)]))
    plane = triangulate.plane_from_pixel(own.centre_mm, own.ray_matrix, truth.laser_normal, truth.plane_offset_mm(x_mm))
    out = triangulate.active(plane, pixels)
    flat = np.ones(len(out), dtype=bool)
    for step in range(-EDGE_ROWS, EDGE_ROWS + 1):
        flat &= np.abs(np.roll(out[:, 2], step) - out[:, 2]) < EDGE_MM
    out[~flat] = np.nan
    return out


def nees_rows(seeds: range = range(1, 9), stripes: int = 10) -> dict[str, float]:
    """Squared errors over the stated covariances, over 3: 1 if the covariances are right."""
    found: dict[str, list[np.ndarray]] = {name: [] for name in ("ST", "AT-left", "AT-right", "ST + AT")}
    settings = OpticalSettings(camera_sigma=CAMERA_SIGMA_PX / 0.04)
    for seed in seeds:
        truth, rng = optical_truth(seed), np.random.default_rng([seed, 5])
        for i, x_mm in enumerate(rng.uniform(-95, 95, stripes)):
            scene = (matte, plate)[i % 2]()
            pipeline = OpticalPipeline.of(
                _moved(camera_of(truth.left), rng), _moved(camera_of(truth.right), rng), _tilted(truth, rng), settings
            )
            pair = [render_stripe(scene, truth, side, x_mm, rng, EXPOSURE_S, True) for side in SIDES]
            seen = pipeline.measure(pair[0], pair[1], x_mm + rng.normal(0, GUIDE_SIGMA_MM), GUIDE_SIGMA_MM)
            lit = {side: true_points(scene, truth, side, x_mm) for side in SIDES}
            xyz = np.column_stack([seen.points[axis] for axis in ("x_mm", "y_mm", "z_mm")]).astype(np.float64)
            row, source = seen.points["row"], seen.points["source"]
            sets = {
                "ST": (xyz, seen.matrices, row, source == 1, lit["left"]),
                "AT-left": (xyz, seen.matrices, row, source == 2, lit["left"]),
                "AT-right": (xyz, seen.matrices, row, source == 3, lit["right"]),
            }
            joint_row = row[source == 1]
            every = np.ones(len(joint_row), dtype=bool)
            sets["ST + AT"] = seen.joint_mm.T, covariance.full(seen.joint_covariance), joint_row, every, lit["left"]
            for name, (points, matrices, rows, chosen, true_mm) in sets.items():
                off = points[chosen] - true_mm[rows[chosen]]
                known = np.isfinite(off[:, 0])
                off, own = off[known], matrices[chosen][known]
                found[name].append(np.einsum("ni,nij,nj->n", off, np.linalg.inv(own), off) / 3)
    print(
        f"\nNEES of the covariances; each stripe has its plane {PLANE_SIGMAS[0]} mm and tilted, its guide "
        f"{GUIDE_SIGMA_MM} mm and its cameras {CAMERA_SIGMA_PX} px off"
    )
    means = {name: float(np.concatenate(values).mean()) for name, values in found.items()}
    print("".join(f"{name:>12} {mean:.3f}" for name, mean in means.items()))
    every = np.concatenate([v for name, values in found.items() if name != "ST + AT" for v in values])
    return {"optical_nees": float(every.mean())}


def points_rows(seconds: float = 8.0) -> dict[str, float]:
    """All figures from frame pairs to points, printed beside their peers and what is asked."""
    cv2.setNumThreads(1)
    figures = (
        triangulation_rows(0.4 * seconds)
        | match_rows(0.2 * seconds)
        | pair_rows(0.4 * seconds)
        | clutter_rows()
        | nees_rows()
    )
    print(f"\n{'points':28}{'measured':>12}{'at least':>10}{'aim':>8}")
    for key, (bar, aim) in TARGETS.items():
        print(f"{key:28}{figures[key]:12.4g}{bar:10g}{aim:8g}")
    return figures
