"""Light: stripe extraction, triangulation, and a frame pair to points, beside the usual ways of doing them."""

from __future__ import annotations

import cv2
import numpy as np
from comparison import Comparison

from echolume_drivers.emulated.optics import CameraTruth, OpticalTruth, optical_truth
from echolume_drivers.emulated.scene import demo, plate
from echolume_drivers.emulated.stripe_image import render_stripe, true_stripe
from echolume_messages.calibration import CameraCalibration, LaserCalibration
from echolume_processing.optical.blais_rioux import blais_rioux_peaks
from echolume_processing.optical.camera import Camera
from echolume_processing.optical.pipeline import OpticalPipeline
from echolume_processing.optical.stripe import extract
from echolume_processing.optical.triangulate import stereo, stereo_eigen

EXPOSURE_S = 4e-3
CENTROID_PX = 5
FILTER = np.array([[1.0, 1.0, 0.0, -1.0, -1.0]], dtype=np.float32)
ROWS = 1024
IMAGE_NOISE_PX = 0.1


def centre_of_mass(frame: np.ndarray) -> np.ndarray:
    """Column of each row: the brightest pixel, and the centre of mass around it above the row's mean."""
    window = np.arange(-CENTROID_PX, CENTROID_PX + 1)
    brightest = np.clip(frame.argmax(axis=1), CENTROID_PX, frame.shape[1] - 1 - CENTROID_PX)
    columns = brightest[:, None] + window
    weight = np.maximum(np.take_along_axis(frame, columns, axis=1) - frame.mean(axis=1, keepdims=True), 0)
    return (weight * columns).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-9)


def filtered(frame: np.ndarray) -> np.ndarray:
    """Column of each row: the fourth-order Blais-Rioux filter by OpenCV, its zero crossing at the brightest pixel."""
    response = cv2.filter2D(frame, cv2.CV_32F, FILTER)
    rows = np.arange(len(frame))
    column = np.clip(frame.argmax(axis=1), 1, frame.shape[1] - 2)
    column = np.where(response[rows, column] > 0, column - 1, column)
    before, after = response[rows, column], response[rows, column + 1]
    crosses = (before <= 0) & (after > 0)
    return np.where(crosses, column - before / np.where(crosses, after - before, 1), np.nan)


def camera_of(truth: CameraTruth) -> CameraCalibration:
    """The emulated camera as a calibration would find it."""
    return CameraCalibration(
        width_px=truth.width_px,
        height_px=truth.height_px,
        camera_matrix=truth.matrix.tolist(),
        distortion=truth.distortion.tolist(),
        camera_from_rig=truth.camera_from_rig.tolist(),
        rms_px=0.0,
    )


def stripes(compare: Comparison, truth: OpticalTruth) -> None:
    """Where the stripe is in each row of a frame."""
    frame = render_stripe(plate(), truth, "left", 10.0, np.random.default_rng(0), EXPOSURE_S, True)
    expected = true_stripe(plate(), truth, "left", 10.0).rows(len(frame))
    finders = {
        "echolume stripe.extract": lambda: extract(frame).column_px[:, 0],
        "argmax + centre of mass": lambda: centre_of_mass(frame),
        "cv2.filter2D Blais-Rioux": lambda: filtered(frame),
        "numpy Blais-Rioux (paper)": lambda: blais_rioux_peaks(frame),
    }
    error = {}
    for name, find in finders.items():
        off_px = find() - expected
        wrong = np.count_nonzero(np.isfinite(expected) & ~(np.abs(off_px) < 1))
        rms_px = np.sqrt(np.nanmean(off_px[np.abs(off_px) < 1] ** 2))
        error[name] = f"RMS {rms_px:.3f} px, {wrong} rows missed or off by more than 1 px"
    ways = {"np.max(frame)": lambda: np.max(frame), **finders}
    compare.section("stripe", "A stripe in a frame of 1280 x 1024 uint8", ways, error)


def triangulations(compare: Comparison, truth: OpticalTruth) -> None:
    """Stereo triangulation of the points of one stripe."""
    rng = np.random.default_rng(1)
    points = rng.uniform([-100, -90, 0], [100, 90, 50], (ROWS, 3))
    left, right = (Camera(c.matrix, c.distortion, c.camera_from_rig) for c in (truth.left, truth.right))
    images = [
        camera.undistort(emulated.project(points)) + rng.normal(0, IMAGE_NOISE_PX, (ROWS, 2))
        for camera, emulated in ((left, truth.left), (right, truth.right))
    ]
    m = left.projection, right.projection

    def opencv() -> np.ndarray:
        homogeneous = cv2.triangulatePoints(*m, images[0].T, images[1].T)
        return (homogeneous[:3] / homogeneous[3]).T

    ways = {
        "echolume stereo (numba)": lambda: stereo(*m, *images),
        "cv2.triangulatePoints": opencv,
        "numpy eigh, batched": lambda: stereo_eigen(*m, *images),
    }
    error = {
        name: f"RMS {np.sqrt(np.mean(np.sum((way() - points) ** 2, axis=1))):.4f} mm at {IMAGE_NOISE_PX} px of noise"
        for name, way in ways.items()
    }
    compare.section("stereo", f"Stereo triangulation of {ROWS} points (eq. 1-2)", ways, error)


def pairs(compare: Comparison, truth: OpticalTruth) -> None:
    """Both frames of a trigger to all three point sets."""
    n, g = truth.laser_normal.tolist(), truth.guide_direction.tolist()
    laser = LaserCalibration(normal=tuple(n), offset_mm=truth.laser_offset_mm, guide_direction=tuple(g), rms_mm=0.0)
    pipeline = OpticalPipeline.of(camera_of(truth.left), camera_of(truth.right), laser)
    rng = np.random.default_rng(2)
    left, right = (render_stripe(demo(), truth, side, -50.0, rng, EXPOSURE_S, True) for side in ("left", "right"))
    ways = {
        "np.max of both": lambda: (np.max(left), np.max(right)),
        "copy of both": lambda: (left.copy(), right.copy()),
        "stripe.extract of both": lambda: (extract(left), extract(right)),
        "echolume pair to points": lambda: pipeline.process(left, right, -50.0),
    }
    found = len(pipeline.process(left, right, -50.0))
    compare.section("pair", "A frame pair to points", ways, {"echolume pair to points": f"{found} points"})


def main() -> None:
    """Run all sections on one thread."""
    compare = Comparison("Speed of the optical chain beside its peers, on one thread.")
    cv2.setNumThreads(1)
    truth = optical_truth(1)
    stripes(compare, truth)
    triangulations(compare, truth)
    pairs(compare, truth)
    compare.finish()


if __name__ == "__main__":
    main()
