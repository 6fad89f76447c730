"""What the emulated array's digitiser records of one ping over a scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from echolume_drivers.emulated import transducer
from echolume_drivers.emulated.array_truth import ArrayTruth
from echolume_drivers.emulated.facets import Facets, build_facets
from echolume_drivers.emulated.kirchhoff import STRIDE, accumulate, accumulate_tilted
from echolume_drivers.emulated.scene import Scene
from echolume_messages.geometry import Matrix, apply, require_shape, rotation_from_vector
from echolume_messages.rig import ArraySettings
from echolume_messages.types import EchoBlock

REFERENCE_PATH_MM = 300.0
REFERENCE_COUNTS = 12000.0
"""Peak over a perpendicular plate at 150 mm, nominal channel."""
OVERSAMPLING = 4
FADE_FROM_TAN, FADE_TO_TAN = 1.0, 1.5
"""Facets fade out between these tangents of the angle seen from the array: the beam has died by then."""
SCATTER_MM = 0.05
"""Incoherent scattering of a rough surface: amplitude of a patch of 1 mm."""

DILATION_MM = 15.0
"""No ray to a receiver strays further than this, below the scene's top, from the ray to the emitter."""

_surfaces: dict[int, Surface] = {}
_KEPT_SURFACES = 4


@dataclass(frozen=True)
class Surface:
    """A scene prepared for sound: facets, their random texture, and its terrain grown twice."""

    scene: Scene
    facets: Facets
    texture: NDArray[np.float64]  # (m,)
    tilted_texture: NDArray[np.float64]  # (k,)
    near: NDArray[np.float64]
    dilated: NDArray[np.float64]


def surface_of(scene: Scene) -> Surface:
    """Prepare a scene, or return what was prepared before."""
    found = _surfaces.get(id(scene))
    if found is not None and found.scene is scene:
        return found
    facets = build_facets(scene)
    texture = SCATTER_MM * np.random.default_rng(len(facets.kind)).normal(size=len(facets.kind))
    tilted_texture = SCATTER_MM * np.random.default_rng([0x71, len(facets.tilted)]).normal(size=len(facets.tilted))
    grown = maximum_filter(scene.front_mm, size=2 * round(DILATION_MM / scene.cell_mm) + 1, mode="constant")
    near = maximum_filter(scene.front_mm, size=2 * STRIDE + 1, mode="constant")
    found = Surface(scene, facets, texture, tilted_texture, near, grown)
    while len(_surfaces) >= _KEPT_SURFACES:
        _surfaces.pop(next(iter(_surfaces)))
    _surfaces[id(scene)] = found
    return found


def _frequencies_hz(array: ArraySettings) -> NDArray[np.float64]:
    return np.arange(array.samples // 2 + 1, dtype=np.float64) * (array.sample_rate_hz / array.samples)


def _in_time(spectra: NDArray[np.complex128], samples: int) -> NDArray[np.float64]:
    return np.fft.irfft(spectra, n=samples, axis=1)


def _element_paths(array: ArraySettings, truth: ArrayTruth) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    elements = np.array([array.layout.emitter_mm, *array.layout.receivers_mm], dtype=np.float64)
    elements[1:] += truth.placement_mm
    return elements, np.linalg.norm(elements[1:] - elements[0], axis=1)


def echo_waveforms(
    scene: Scene, rig_from_array: Matrix, array: ArraySettings, truth: ArrayTruth, temperature_c: float
) -> NDArray[np.float64]:
    """Noiseless record of one ping in digitiser counts, float64 (receivers, samples).

    Parameters
    ----------
    scene
        Heightfield; sound reflects from `front_mm` whatever the material.
    rig_from_array
        True pose of the array (4, 4), mm; its z axis looks at the scene.
    array, truth
        Nominal build with sampling and pulse; what the array really is.
    temperature_c
        Air on the sound's way.

    Notes
    -----
    Kirchhoff approximation with soft shadows and one floor-wall double bounce; no wall-wall bounces, none between
    tilted surfaces, nothing below an overhang, and no echo between array and bench. Echoes after the record's end
    are lost, as in the device.
    """
    require_shape("rig_from_array", rig_from_array, (4, 4))
    surface = surface_of(scene)
    facets = surface.facets
    elements, direct_mm = _element_paths(array, truth)
    receivers = len(direct_mm)
    speed_mps = transducer.speed_of_sound_mps(temperature_c)
    bands_hz = np.array(transducer.BANDS[array.pulse])
    fine_hz = array.sample_rate_hz * OVERSAMPLING
    bin_mm = speed_mps * 1e3 / fine_hz
    bins = array.samples * OVERSAMPLING
    history = np.zeros((receivers, bins, len(bands_hz)), dtype=np.float32)
    height_mm = max(float(rig_from_array[2, 3]), 1.0)
    origin_mm = np.array([scene.x0_mm, scene.y0_mm])
    waves = (
        apply(rig_from_array, elements), rig_from_array[:3, 2].copy(),
        transducer.directivity_table(bands_hz, truth.radius_mm, speed_mps),
        2 * np.pi * bands_hz / (speed_mps * 1e3), truth.radius_mm,
        (FADE_FROM_TAN * height_mm, FADE_TO_TAN * height_mm),
        bin_mm, array.start_s * speed_mps * 1e3, history,
    )  # fmt: skip
    accumulate(
        facets.centre_mm, facets.kind, facets.sign, facets.size_mm, facets.floor_mm, surface.texture,
        scene.front_mm, surface.near, surface.dilated, origin_mm, scene.cell_mm, *waves,
    )  # fmt: skip
    if len(facets.tilted):
        accumulate_tilted(facets.tilted, surface.tilted_texture, scene.front_mm, origin_mm, scene.cell_mm, *waves)
    f_hz = _frequencies_hz(array)
    weights = transducer.band_weights(f_hz, bands_hz)
    # mean loss of spreading each delta over two bins
    weights = weights / (1 - (2 * np.pi * f_hz / fine_hz) ** 2 / 12)
    spectrum = np.einsum("rfb,bf->rf", np.fft.rfft(history, axis=1)[:, : len(f_hz)], weights)
    pulses = transducer.channel_spectra(array, truth, f_hz)
    wavenumber = 2 * np.pi * f_hz / (speed_mps * 1e3)
    scale = REFERENCE_COUNTS * REFERENCE_PATH_MM * array.sample_rate_hz
    far = _in_time(1j * wavenumber * spectrum * pulses, array.samples)
    near = _in_time(spectrum * pulses, array.samples)
    t_s = array.start_s + np.arange(array.samples) / array.sample_rate_hz - truth.delays_s[:, None]
    echo = scale * (far + near * 2 / np.maximum(t_s * speed_mps * 1e3, 20.0))
    if scene.air.sound_db_per_m > 0:
        echo *= 10 ** (-scene.air.sound_db_per_m / 20 * speed_mps * np.maximum(t_s, 0.0))
    arrival_s = direct_mm[:, None] / (speed_mps * 1e3) - array.start_s
    talk = truth.cross_talk[:, None] * pulses * np.exp(-2j * np.pi * f_hz * arrival_s)
    direct = _in_time(talk, array.samples) if array.start_s == 0 else np.zeros_like(echo)
    return echo + REFERENCE_COUNTS * array.sample_rate_hz * direct


def noise_counts(array: ArraySettings, truth: ArrayTruth) -> float:
    """Rms of the white noise that gives `truth.snr_db` after a matched filter over a plate at 150 mm."""
    f_hz = _frequencies_hz(array)
    pulses = transducer.channel_spectra(array, truth, f_hz) / truth.gains[:, None]
    pulse = REFERENCE_COUNTS * array.sample_rate_hz * _in_time(pulses, array.samples)
    root_energy = float(np.sqrt(np.mean(np.sum(pulse**2, axis=1))))
    return root_energy / 10 ** (truth.snr_db / 20)


def simulate_ping(
    scene: Scene,
    rig_from_array: Matrix,
    array: ArraySettings,
    truth: ArrayTruth,
    temperature_c: float,
    rng: np.random.Generator,
) -> EchoBlock:
    """One ping with pose jitter, moving air, noise and quantisation, int16 (receivers, samples).

    Parameters as `echo_waveforms`; all randomness comes from `rng`, so the same generator state gives the same
    record.
    """
    n = len(truth.gains)
    jittered = rig_from_array.copy()
    jittered[:3, 3] += rng.normal(0, truth.pose_sigma_mm, 3)
    jittered[:3, :3] = rotation_from_vector(rng.normal(0, truth.pose_sigma_mm / 400, 3)) @ jittered[:3, :3]
    # the speed goes with the root of the temperature
    warm_k = 2 * (273.15 + temperature_c) * rng.normal(0, truth.air_sigma)
    clean = echo_waveforms(scene, jittered, array, truth, temperature_c + warm_k)
    f_hz = _frequencies_hz(array)
    shift_s = rng.normal(0, truth.timing_sigma_s, (n, 1))
    level = 1 + rng.normal(0, truth.amplitude_sigma)
    moved = level * _in_time(np.fft.rfft(clean, axis=1) * np.exp(-2j * np.pi * f_hz * shift_s), array.samples)
    noisy = moved + rng.normal(0, noise_counts(array, truth), moved.shape)
    return np.clip(np.rint(noisy), -32768, 32767).astype(np.int16)
