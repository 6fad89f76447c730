"""Chirps and codes, compressed by the same matched filter with templates of the same kind."""

from __future__ import annotations

import numpy as np
import pytest

from echolume_processing.ultrasonic import excitation
from echolume_processing.ultrasonic.matched_filter import PLAIN, matched_filter
from processing.echo_pulses import F_HZ, LENGTH, RATE_HZ, SPEED_MM_PER_S, wideband

BAND_HZ = (30e3, 60e3)
DRIVES = {
    "burst": excitation.burst(45e3, 8 / 45e3, RATE_HZ),
    "chirp": excitation.chirp(28e3, 62e3, 2e-3, RATE_HZ),
    "barker 13": excitation.coded(excitation.BARKER[13], 45e3, 2, RATE_HZ),
    "pseudo-random 63": excitation.coded(excitation.pseudo_random(6), 45e3, 2, RATE_HZ),
}


def heard(drive: np.ndarray, at: float) -> np.ndarray:
    """A drive through the transducers' band, `at` samples late, (1, LENGTH / 2)."""
    spectrum = np.fft.rfft(drive, LENGTH) * wideband() / np.abs(wideband()).max()
    return np.fft.irfft(spectrum * np.exp(-2j * np.pi * F_HZ * at / RATE_HZ), LENGTH)[None, : LENGTH // 2]


def compressed(name: str) -> tuple[np.ndarray, float, float]:
    """Magnitude of an echo at sample 500.3, its rate, and the noise's gain."""
    template = heard(DRIVES[name], 60.0)[:, : len(DRIVES[name]) + 120].astype(np.float32)
    bank = matched_filter(template, 60.0, RATE_HZ, BAND_HZ, LENGTH // 2, whitening=PLAIN)
    out = bank.compress(heard(DRIVES[name], 500.3).astype(np.float32))[0]
    return np.abs(out), 4 * RATE_HZ, float(bank.noise_gain[0])


def width_mm(magnitude: np.ndarray, rate_hz: float) -> float:
    peak = int(magnitude.argmax())
    before, after = magnitude[:peak][::-1], magnitude[peak:]
    return (int(np.argmax(before < 0.5)) + int(np.argmax(after < 0.5)) + 1) / rate_hz * SPEED_MM_PER_S / 2


@pytest.mark.parametrize("name", DRIVES)
def test_a_compressed_drive_peaks_where_its_echo_arrived(name: str):
    magnitude, rate_hz, _ = compressed(name)
    assert magnitude.argmax() / rate_hz * RATE_HZ == pytest.approx(500.3, abs=0.3)
    assert magnitude.max() == pytest.approx(1.0, abs=0.02)


def test_a_chirp_of_2_ms_is_as_sharp_as_its_band_allows():
    sharp = width_mm(*compressed("chirp")[:2])
    assert len(DRIVES["chirp"]) / RATE_HZ * SPEED_MM_PER_S / 2 > 340  # mm of range, uncompressed
    assert sharp < 9.0
    assert width_mm(*compressed("barker 13")[:2]) < 10.0
    assert width_mm(*compressed("burst")[:2]) > 15.0


def test_the_gain_of_a_drive_is_the_root_of_its_energy():
    gains = {name: 1 / compressed(name)[2] for name in DRIVES}
    energies = {name: float(np.sum(heard(drive, 60.0) ** 2)) for name, drive in DRIVES.items()}
    for name in ("chirp", "barker 13", "pseudo-random 63"):
        gain_db = 20 * np.log10(gains[name] / gains["burst"])
        assert gain_db == pytest.approx(10 * np.log10(energies[name] / energies["burst"]), abs=0.3)
    assert 20 * np.log10(gains["chirp"] / gains["burst"]) > 8
    assert 20 * np.log10(gains["pseudo-random 63"] / gains["burst"]) > 10


def test_barkers_codes_have_side_lobes_of_one():
    for length, code in excitation.BARKER.items():
        lobes = np.abs(np.correlate(code, code, "full"))
        assert lobes.max() == length
        assert np.sort(lobes)[-2] == 1


def test_a_maximum_length_sequence_is_balanced_and_its_circular_correlation_flat():
    chips = excitation.pseudo_random(6)
    circular = [int(np.dot(chips, np.roll(chips, k))) for k in range(63)]
    assert circular == [63] + [-1] * 62


def test_drives_that_cannot_be_are_refused():
    with pytest.raises(ValueError, match="half the sample rate"):
        excitation.chirp(30e3, 200e3, 1e-3, RATE_HZ)
    with pytest.raises(ValueError, match="1 and -1"):
        excitation.coded([1, 0, 1], 40e3, 2, RATE_HZ)
