"""Sound: a ping to contact points, and its parts, beside the libraries' own functions on the same data."""

from __future__ import annotations

import numpy as np
from comparison import Comparison
from scipy import fft, signal

from echolume_drivers.emulated.array_truth import ArrayTruth, array_truth
from echolume_drivers.emulated.echoes import simulate_ping
from echolume_drivers.emulated.scene import Scene, demo, plate
from echolume_messages.plan import Pose6
from echolume_messages.rig import ArraySettings
from echolume_processing.ping import Ping
from echolume_processing.ultrasonic.calibrate import calibrate_plate
from echolume_processing.ultrasonic.contact import contact, fit_plane
from echolume_processing.ultrasonic.envelope import band_pass, paper_envelope
from echolume_processing.ultrasonic.pipeline import UltrasonicPipeline, waveforms_from_counts
from echolume_processing.ultrasonic.poses import plate_poses

SETTINGS = ArraySettings(port="none")
AIR_C = 22.0
SIGMA_MM = 0.05


def take(scene: Scene, poses: list[Pose6], truth: ArrayTruth) -> list[Ping]:
    """Emulated pings over a scene; angles of the poses in degrees."""
    rng = np.random.default_rng(1)
    out: list[Ping] = []
    for number, (x, y, z, rx, ry, rz) in enumerate(poses):
        pose = np.array([x, y, z, *np.radians([rx, ry, rz])])
        echoes = simulate_ping(scene, truth.rig_from_array(pose), SETTINGS, truth, AIR_C, rng)
        out.append(Ping(number, echoes, pose, SETTINGS.sample_rate_hz, SETTINGS.start_s, AIR_C))
    return out


def pings(compare: Comparison, pipeline: UltrasonicPipeline, ping: Ping) -> None:
    """Raw counts to contact points, and the steps on the way."""
    floats = waveforms_from_counts(ping.echoes)
    rate_hz = ping.sample_rate_hz
    ways = {
        "one FFT (scipy rfft)": lambda: fft.rfft(floats, axis=1),
        "counts to float32": lambda: waveforms_from_counts(ping.echoes),
        "echolume matched filter": lambda: pipeline.compress(floats, rate_hz),
        "echolume ping to points": lambda: pipeline.process(ping),
    }
    found = len(pipeline.process(ping))
    compare.section("ping", "A ping of 8 x 1024 int16", ways, {"echolume ping to points": f"{found} points"})


def envelopes(compare: Comparison, ping: Ping) -> None:
    """The envelope in the paper's manner and in the libraries'."""
    floats = waveforms_from_counts(ping.echoes)
    rate_hz = ping.sample_rate_hz
    sections = signal.butter(3, [30e3, 60e3], "bandpass", fs=rate_hz, output="sos")
    ways = {
        "scipy hilbert": lambda: np.abs(signal.hilbert(floats, axis=1)),
        "scipy sosfiltfilt band-pass": lambda: signal.sosfiltfilt(sections, floats, axis=1),
        "echolume band_pass": lambda: band_pass(floats, rate_hz, 30e3, 60e3),
        "echolume paper_envelope": lambda: paper_envelope(floats, rate_hz),
    }
    compare.section("envelope", "Envelopes of the same ping", ways)


def contacts(compare: Comparison) -> None:
    """Path lengths to a plane."""
    receivers = np.array(SETTINGS.layout.receivers_mm)
    normal = np.array([0.1, -0.05, 1.0]) / np.linalg.norm([0.1, -0.05, 1.0])
    paths = np.linalg.norm(receivers - 2 * 150.0 * normal, axis=1)
    rows = np.column_stack([-2 * receivers[:, :2], np.ones(len(receivers))])
    squares = paths**2 - np.sum(receivers**2, axis=1)
    everyone, sigma_mm = np.ones(len(receivers), dtype=np.bool_), np.full(len(receivers), SIGMA_MM)
    ways = {
        "np.linalg.lstsq, linear part": lambda: np.linalg.lstsq(rows, squares, rcond=None),
        "echolume fit_plane": lambda: fit_plane(receivers, paths, everyone),
        "echolume contact": lambda: contact(receivers, paths, sigma_mm),
    }
    note = {"echolume contact": "plane and point models, tested against each other, and contact points"}
    compare.section("contact", "Contact points of one ping's 8 path lengths", ways, note)


def main() -> None:
    """Calibrate an emulated array and run all sections."""
    compare = Comparison("Speed of the ultrasonic chain beside its peers.")
    truth = array_truth(1, SETTINGS)
    pipeline = UltrasonicPipeline(calibrate_plate(take(plate(), plate_poses(), truth), SETTINGS).calibration)
    ping = take(demo(), [(-80.0, 60.0, 150.0, 0.0, 0.0, 0.0)], truth)[0]
    pings(compare, pipeline, ping)
    envelopes(compare, ping)
    contacts(compare)
    compare.finish()


if __name__ == "__main__":
    main()
