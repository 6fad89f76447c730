"""Figures of the acoustic images: delay-and-sum by FFT, by numba and in C, its memory, and its lateral resolution."""

from __future__ import annotations

import ctypes
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pymust
from scipy import signal

from echolume_processing.ultrasonic.acoustics import directivity
from echolume_processing.ultrasonic.das_gather import sharpened, turn_weights
from echolume_processing.ultrasonic.das_kernels import lay_poses
from echolume_processing.ultrasonic.delay_and_sum import delay_and_sum
from echolume_processing.ultrasonic.gated import Band, GatedEchoes
from echolume_processing.ultrasonic.voxels import VoxelGrid

SPEED_MPS, CARRIER_HZ, RADIUS_MM = 343.2, 40e3, 6.22
POSES, PITCH_MM, HEIGHT_MM = 40, 5.0, 400.0
RECEIVERS_MM = np.array([(x, y, 0.0) for y in (-15, 0, 15) for x in (-15, 0, 15) if (x, y) != (0, 0)])
BAND = Band(37e3, 43e3, SPEED_MPS)
GATE_MM = (650.0, 1150.0)
TARGETS_MM = np.array([(0, 0, 0), (30, -20, 12), (60, 80, -40), (-75, 40, 25)], dtype=np.float64)
SHAPE, STEP_MM = (64, 128, 128), (2.5, 2.5, 2.0)
SHARE = 8
"""Rows of 128 that the slow ways are timed on; their time is scaled to all."""
CHECKED = 300

TARGETS: Mapping[str, tuple[float, float]] = {
    "fft_das_vs_gather": (10, 20),
    "fft_das_corr": (0.999, 0.999),
    "gather_vs_c": (2, 1.5),
    "das_peak_gb": (0.5, 0.5),
    "lateral_mm_400": (12, 12),
}
"""What is asked, at least or at most, and the aim."""

LOOP = r"""
#include <math.h>
#include <stdint.h>
#include <string.h>
/* The gather of das_kernels.py, written again. SPLIT: reading the samples is a loop of its own. */
void gather(float *out, const float *iq, const double *em, const double *rc, const double *x, const double *y,
            const float *z, int poses, int channels, int samples, int nx, int ny, int nz, float per_mm, float first,
            float turns, const float *weights) {
  float leg[256], part[256], turn[256], low[512], high[512];
  int32_t at[256];
  const float *c = weights, *s = weights + 6;
  const float top = samples - 2;
  for (int p = 0; p < poses; p++)
    for (int iy = 0; iy < ny; iy++)
      for (int ix = 0; ix < nx; ix++) {
        double dx = x[ix] - em[3 * p], dy = y[iy] - em[3 * p + 1];
        float rho = dx * dx + dy * dy, up = em[3 * p + 2];
        for (int k = 0; k < nz; k++) leg[k] = sqrtf(rho + (z[k] - up) * (z[k] - up)) * per_mm - first;
        float *re = out + ((size_t)iy * nx + ix) * nz, *im = re + (size_t)ny * nx * nz;
        for (int ch = 0; ch < channels; ch++) {
          const double *r = rc + 3 * (p * channels + ch);
          const float *row = iq + 2 * ((size_t)p * channels + ch) * samples;
          dx = x[ix] - r[0]; dy = y[iy] - r[1]; rho = dx * dx + dy * dy; up = r[2];
#ifdef SPLIT
          for (int k = 0; k < nz; k++) {
            float u = leg[k] + sqrtf(rho + (z[k] - up) * (z[k] - up)) * per_mm;
            u = fminf(fmaxf(u, 0.0f), top);
            int32_t j = (int32_t)u;
            at[k] = j; part[k] = u - j; u *= turns; turn[k] = u - floorf(u + 0.5f);
          }
          for (int k = 0; k < nz; k++) {
            memcpy(low + 2 * k, row + 2 * at[k], 8);
            memcpy(high + 2 * k, row + 2 * at[k] + 2, 8);
          }
          for (int k = 0; k < nz; k++) {
            float f = part[k], t = turn[k], h = t * t;
            float a = low[2 * k] + f * (high[2 * k] - low[2 * k]);
            float b = low[2 * k + 1] + f * (high[2 * k + 1] - low[2 * k + 1]);
#else
          for (int k = 0; k < nz; k++) {
            float u = leg[k] + sqrtf(rho + (z[k] - up) * (z[k] - up)) * per_mm;
            u = fminf(fmaxf(u, 0.0f), top);
            int32_t j = (int32_t)u;
            float f = u - j; u *= turns;
            float t = u - floorf(u + 0.5f), h = t * t;
            const float *v = row + 2 * j;
            float a = v[0] + f * (v[2] - v[0]), b = v[1] + f * (v[3] - v[1]);
#endif
            float cosine = c[0] + h * (c[1] + h * (c[2] + h * (c[3] + h * (c[4] + h * c[5]))));
            float sine = t * (s[0] + h * (s[1] + h * (s[2] + h * (s[3] + h * (s[4] + h * s[5])))));
            re[k] += a * cosine - b * sine;
            im[k] += a * sine + b * cosine;
          }
        }
      }
}
"""

PEAK = """
import json, resource
from comparison.imaging import echoes_of_scan, grid_of, TARGETS_MM, part_of
from echolume_processing.ultrasonic.delay_and_sum import delay_and_sum
from echolume_processing.ultrasonic.voxels import VoxelGrid
echoes = echoes_of_scan(TARGETS_MM)
small = VoxelGrid(grid_of().rig_from_grid, grid_of().first_mm, grid_of().step_mm, (1, 4, 4))
few = part_of(echoes, 64)
for method in ("fft", "gather"):
    delay_and_sum(echoes, small, method, coherence=True)
def held(): return 4096 * int(open("/proc/self/statm").read().split()[1])
def peak(): return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
before = held()
# The scan itself counts too: it is held during the sums.
own = echoes.iq.nbytes + echoes.receivers_mm.nbytes
delay_and_sum(few, grid_of(), "gather", coherence=True)
gathered = peak()
delay_and_sum(echoes, grid_of(), "fft")
plain = peak()
delay_and_sum(echoes, grid_of(), "fft", coherence=True)
print(json.dumps([(p - before + own) / 1e9 for p in (gathered, plain, peak())]))
"""


def pulse() -> tuple[np.ndarray, np.ndarray]:
    """Echo of eight cycles at 40 kHz through an emitter and a receiver of Q 20 after its matched filter: path in mm,
    complex baseband; 1 at path 0.
    """
    rate_hz = 4e6
    burst = np.zeros(16000)
    burst[: round(8 * rate_hz / CARRIER_HZ)] = np.sin(
        2 * np.pi * CARRIER_HZ / rate_hz * np.arange(round(8 * rate_hz / CARRIER_HZ))
    )
    for _ in range(2):
        burst = signal.lfilter(*signal.iirpeak(CARRIER_HZ, 20, fs=rate_hz), burst)
    spectrum = np.abs(np.fft.fft(burst, 2 * len(burst))) ** 2
    frequency_hz = np.fft.fftfreq(len(spectrum), 1 / rate_hz)
    away = np.abs(frequency_hz - CARRIER_HZ)
    spectrum[away > 3e3] *= 0.5 * (1 + np.cos(np.pi * np.clip((away[away > 3e3] - 3e3) / 2e3, 0, 1)))
    analytic = np.fft.fftshift(np.fft.ifft(spectrum / spectrum.sum())) * len(spectrum)
    path_mm = (np.arange(len(spectrum)) - len(spectrum) // 2) / rate_hz * 1e3 * SPEED_MPS
    inside = np.abs(path_mm) < 700
    return path_mm[inside], (analytic * np.exp(-1j * BAND.wavenumber * path_mm))[inside]


def raster_mm() -> np.ndarray:
    """Emitters of the scan, (1600, 3)."""
    x, y = np.meshgrid(*[PITCH_MM * (np.arange(POSES) - 0.5 * (POSES - 1))] * 2)
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, HEIGHT_MM)])


def heard(emitters: np.ndarray, target_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Path and amplitude of a point's echo (1 on the axis) at every pose and receiver: spreading and two-way beam."""
    receivers = emitters[:, None] + RECEIVERS_MM
    out, back = np.linalg.norm(target_mm - emitters, axis=1)[:, None], np.linalg.norm(target_mm - receivers, axis=2)
    drop = HEIGHT_MM - target_mm[2]
    beam = [directivity(BAND.wavenumber * RADIUS_MM * np.sqrt(np.maximum(1 - (drop / r) ** 2, 0))) for r in (out, back)]
    return out + back, beam[0] * beam[1] * drop**2 / (out * back)


def echoes_of_scan(targets_mm: np.ndarray, snr_db: float | None = 30.0) -> GatedEchoes:
    """Echoes of point targets with noise in the band, made without the code under test."""
    emitters = raster_mm()
    path = GATE_MM[0] + BAND.step_mm * np.arange(int((GATE_MM[1] - GATE_MM[0]) / BAND.step_mm))
    at, shape = pulse()
    iq = np.zeros((len(emitters), len(RECEIVERS_MM), len(path)), dtype=np.complex64)
    for target in targets_mm:
        arrival, level = heard(emitters, target)
        away = (path - arrival[..., None]).ravel()
        wave = np.interp(away, at, shape.real) + 1j * np.interp(away, at, shape.imag)
        turn = np.exp(-1j * BAND.wavenumber * arrival) * level
        iq += (wave.reshape(iq.shape) * turn[..., None]).astype(np.complex64)
    if snr_db is not None:
        rng = np.random.default_rng(0)
        noise = np.fft.fft(rng.normal(size=iq.shape) + 1j * rng.normal(size=iq.shape), axis=2)
        noise[:, :, np.abs(np.fft.fftfreq(len(path), BAND.step_mm)) > 0.5 * BAND.width] = 0
        noise = np.fft.ifft(noise, axis=2)
        iq += (noise * 10 ** (-snr_db / 20) / np.sqrt(np.mean(np.abs(noise) ** 2))).astype(np.complex64)
    axes = np.tile([0.0, 0.0, -1.0], (len(emitters), 1))
    receivers = emitters[:, None] + RECEIVERS_MM
    return GatedEchoes(iq, GATE_MM[0], BAND.step_mm, BAND.wavenumber, BAND.width, emitters, receivers, axes)


def part_of(echoes: GatedEchoes, poses: int) -> GatedEchoes:
    """The first poses of a scan."""
    return GatedEchoes(
        echoes.iq[:poses], echoes.first_mm, echoes.step_mm, echoes.wavenumber, echoes.bandwidth,
        echoes.emitters_mm[:poses], echoes.receivers_mm[:poses], echoes.axes[:poses],
    )  # fmt: skip


def grid_of(rows: int = SHAPE[1], first_row: int = 0) -> VoxelGrid:
    """128 x 128 x 64 voxels around the targets, or some of their rows."""
    first = [-0.5 * s * (n - 1) for s, n in zip(STEP_MM, SHAPE[::-1], strict=True)]
    return VoxelGrid(
        np.eye(4), (first[0], first[1] + first_row * STEP_MM[1], first[2]), STEP_MM, (SHAPE[0], rows, SHAPE[2])
    )


def cpu_s(work: Callable[[], object]) -> float:
    """Processor time of one call: other processes on the machine do not count."""
    began_s = time.process_time()
    work()
    return time.process_time() - began_s


def compiled(folder: Path, name: str, *flags: str) -> Callable[..., None] | None:
    """The C loop, or none where there is no compiler."""
    compiler = shutil.which("cc")
    if compiler is None:
        return None
    source, library = folder / "gather.c", folder / f"{name}.so"
    source.write_text(LOOP, encoding="utf-8")
    options = ["-O3", "-march=native", "-ffast-math", "-shared", "-fPIC", *flags]
    subprocess.run([compiler, *options, str(source), "-o", str(library), "-lm"], check=True)
    return ctypes.CDLL(str(library)).gather


def c_way(loop: Callable[..., None], echoes: GatedEchoes, grid: VoxelGrid, out: np.ndarray) -> Callable[[], None]:
    """A call of the C loop on a grid's columns; `out` (2, ny, nx, nz) is set to the sums."""
    iq, z = sharpened(echoes.iq), grid.z_mm.astype(np.float32)
    x, y, em, rc = grid.x_mm, grid.y_mm, echoes.emitters_mm, echoes.receivers_mm
    weights = turn_weights()
    scale = [1 / echoes.step_mm, echoes.first_mm / echoes.step_mm, echoes.wavenumber * echoes.step_mm / (2 * np.pi)]

    def work() -> None:
        out[:] = 0
        counts = (*iq.shape, len(x), len(y), len(z))
        arrays = [a.ctypes.data_as(ctypes.c_void_p) for a in (out, iq, em, rc, x, y, z)]
        loop(*arrays, *map(ctypes.c_int, counts), *map(ctypes.c_float, scale), weights.ctypes.data_as(ctypes.c_void_p))

    return work


def numba_way(echoes: GatedEchoes, grid: VoxelGrid, out: np.ndarray) -> Callable[[], None]:
    """The same by the compiled kernel of the product; `out` (4, ny, nx, nz)."""
    iq = sharpened(echoes.iq).view(np.float64)
    turns = echoes.wavenumber * echoes.step_mm / (2 * np.pi)
    scale, weights = np.array([1 / echoes.step_mm, echoes.first_mm / echoes.step_mm, turns]), turn_weights()

    def work() -> None:
        out[:] = 0
        lay_poses(
            out, iq, echoes.emitters_mm, echoes.receivers_mm, echoes.axes, grid.x_mm, grid.y_mm, grid.z_mm, scale,
            weights, -2.0, False,
        )  # fmt: skip

    return work


def exact(echoes: GatedEchoes, points_mm: np.ndarray, targets_mm: np.ndarray) -> np.ndarray:
    """The sum at some points, written out: every target's wave at every path, in double precision."""
    at, shape = pulse()
    total = np.zeros(len(points_mm), dtype=np.complex128)
    for target in targets_mm:
        arrival, level = heard(echoes.emitters_mm, target)
        for k, point in enumerate(points_mm):
            away = heard(echoes.emitters_mm, point)[0] - arrival
            wave = np.interp(away, at, shape.real) + 1j * np.interp(away, at, shape.imag)
            total[k] += np.mean(level * wave * np.exp(1j * BAND.wavenumber * away))
    return total


def speed_rows() -> dict[str, float]:
    """FFT, gather and C in turns, in processor time; and how well they agree."""
    echoes, whole = echoes_of_scan(TARGETS_MM), grid_of()
    first_row = SHAPE[1] // 2 - SHARE // 2
    share, scaled = grid_of(SHARE, first_row), SHAPE[1] / SHARE
    found: dict[str, np.ndarray] = {}
    sums = np.zeros((4, SHARE, SHAPE[2], SHAPE[0]), dtype=np.float32)
    c_sums = np.zeros((2, SHARE, SHAPE[2], SHAPE[0]), dtype=np.float32)
    with tempfile.TemporaryDirectory() as name:
        loops = {n: compiled(Path(name), n, *flags) for n, flags in (("one loop", ()), ("split", ("-DSPLIT",)))}
        ways: dict[str, Callable[[], object]] = {
            "FFT": lambda: found.update(fft=delay_and_sum(echoes, whole, "fft").values),
            "gather": lambda: found.update(gather=delay_and_sum(echoes, share, "gather").values),
            "numba kernel": numba_way(echoes, share, sums),
        }
        ways |= {f"C, {n}": c_way(loop, echoes, share, c_sums) for n, loop in loops.items() if loop is not None}
        delay_and_sum(echoes, grid_of(1), "gather")
        delay_and_sum(echoes, VoxelGrid(np.eye(4), whole.first_mm, STEP_MM, (1, 128, 128)), "fft")
        spent_s: dict[str, list[float]] = {n: [] for n in ways}
        for _ in range(3):
            for n, work in ways.items():
                spent_s[n].append(cpu_s(work))
    time_s = {n: float(np.median(s)) * (1 if n == "FFT" else scaled) for n, s in spent_s.items()}
    work_units = np.prod(SHAPE) * len(echoes.iq) * len(RECEIVERS_MM)
    print(f"\nDelay-and-sum of 40 x 40 poses, 8 receivers, 128 x 128 x 64 voxels ({work_units:.2e} voxel-channels)")
    print(
        f"processor time; all but the FFT on {SHARE} of 128 rows, scaled\n{'':24}{'whole':>10}{'each':>11}{'x FFT':>8}"
    )
    time_s["numpy (40 poses, 1 slice)"] = numpy_s(echoes) * work_units
    for n, value in time_s.items():
        print(f"{n:25}{value:8.1f} s{1e9 * value / work_units:8.2f} ns{value / time_s['FFT']:8.1f}")
    rows = slice(first_row, first_row + SHARE)
    a, b = found["fft"][:, rows].ravel(), found["gather"].ravel()
    alike = float(abs(np.vdot(a, b)) / (np.linalg.norm(a) * np.linalg.norm(b)))
    by_c = np.moveaxis(c_sums[0] + 1j * c_sums[1], -1, 0).ravel()
    by_numba = np.moveaxis(sums[0] + 1j * sums[1], -1, 0).ravel()
    print(f"correlation FFT - gather {alike:.6f} (magnitudes {np.corrcoef(np.abs(a), np.abs(b))[0, 1]:.6f})", end="")
    out = {"fft_das_vs_gather": time_s["gather"] / time_s["FFT"], "fft_das_corr": alike}
    if len(time_s) > 4:
        print(f"; numba - C, largest difference {np.abs(by_c - by_numba).max() / np.abs(by_c).max():.1e}", end="")
        out["gather_vs_c"] = time_s["numba kernel"] / min(time_s[n] for n in time_s if n.startswith("C,"))
    print()
    return out | accuracy_rows()


def accuracy_rows() -> dict[str, float]:
    """Errors of both ways against sums written out, without noise."""
    echoes, row = echoes_of_scan(TARGETS_MM, None), SHAPE[1] // 2
    ways = {
        "fft": delay_and_sum(echoes, grid_of(), "fft").values[:, row : row + 1],
        "gather": delay_and_sum(echoes, grid_of(1, row), "gather").values,
    }
    grid = grid_of(1, row)
    chosen = np.random.default_rng(1).integers(0, (SHAPE[0], SHAPE[2]), (CHECKED, 2))
    points = np.column_stack([grid.x_mm[chosen[:, 1]], np.full(CHECKED, grid.y_mm[0]), grid.z_mm[chosen[:, 0]]])
    truth = exact(echoes, points, TARGETS_MM)
    for name, values in ways.items():
        error = np.linalg.norm(values[chosen[:, 0], 0, chosen[:, 1]] - truth) / np.linalg.norm(truth)
        print(f"{name}: {100 * error:.3f} % of sums written out in double precision at {CHECKED} voxels")
    return {}


def numpy_s(echoes: GatedEchoes, poses: int = 40) -> float:
    """Processor time of one voxel-channel in numpy: a slice of 128 x 128, some poses."""
    grid = grid_of()
    x, y = np.meshgrid(grid.x_mm, grid.y_mm)
    iq = echoes.iq[:poses]

    def work() -> np.ndarray:
        total = np.zeros(x.shape, dtype=np.complex64)
        for pose, emitter, receivers in zip(iq, echoes.emitters_mm, echoes.receivers_mm, strict=False):
            leg = np.sqrt((x - emitter[0]) ** 2 + (y - emitter[1]) ** 2 + emitter[2] ** 2)
            for row, at in zip(pose, receivers, strict=True):
                path = leg + np.sqrt((x - at[0]) ** 2 + (y - at[1]) ** 2 + at[2] ** 2)
                u = np.clip((path - echoes.first_mm) / echoes.step_mm, 0, len(row) - 2)
                n = u.astype(np.int32)
                value = row[n] + (u - n).astype(np.float32) * (row[n + 1] - row[n])
                total += value * np.exp(1j * echoes.wavenumber * path).astype(np.complex64)
        return total

    return cpu_s(work) / (x.size * poses * len(RECEIVERS_MM))


def pymust_lines() -> None:
    """The same kind of work in two dimensions by pymust: its matrix, and the product."""
    elements, samples, across, deep = 64, 512, 128, 64
    param = pymust.utils.Param()
    param.fs, param.c, param.fc, param.pitch, param.Nelements = 40e3, SPEED_MPS, CARRIER_HZ, 5e-3, elements
    x, z = np.meshgrid(np.linspace(-0.15, 0.15, across), np.linspace(0.3, 0.5, deep))
    delays = np.zeros((1, elements))
    data = np.random.default_rng(0).normal(size=(samples, elements)) + 0j
    found: list[object] = []
    build_s = cpu_s(lambda: found.append(pymust.dasmtx(1j * np.array(data.shape), x, z, delays, param)))
    matrix = found[0]
    flat = data.flatten(order="F")
    product_s = float(np.median([cpu_s(lambda: matrix @ flat) for _ in range(5)]))  # type: ignore[operator]
    unit = x.size * elements
    print(
        f"pymust.dasmtx, {across} x {deep} pixels, {elements} elements: {1e9 * build_s / unit:.0f} ns a pixel-element "
        f"to build the matrix, then {1e9 * product_s / unit:.1f} ns for each product"
    )


def peak_rows() -> dict[str, float]:
    """Growth of a child process that makes the whole volume."""
    here = Path(__file__).resolve().parents[1]  # where the child finds this package
    out = subprocess.run([sys.executable, "-c", PEAK], capture_output=True, text=True, check=True, cwd=here).stdout
    gathered, plain, coherent = json.loads(out)
    print(
        f"\nPeak memory of the 128 x 128 x 64 volume, the gated scan included: gather with coherence {gathered:.3f}, "
        f"FFT {plain:.3f}, FFT with coherence {coherent:.3f} GB"
    )
    return {"das_peak_gb": max(gathered, plain, coherent)}


def width_mm(places: np.ndarray, level: np.ndarray) -> float:
    """Full width at half the largest value, both flanks inside, by linear interpolation; nan where clipped."""
    peak = int(np.argmax(level))
    half = 0.5 * level[peak]
    left, right = np.flatnonzero(level[:peak] < half), np.flatnonzero(level[peak:] < half)
    if not left.size or not right.size:
        return float("nan")
    i, j = int(left[-1]), peak + int(right[0])
    low = np.interp(half, level[i : i + 2], places[i : i + 2])
    high = np.interp(-half, -level[j - 1 : j + 1], places[j - 1 : j + 1])
    return float(high - low)


def lateral_rows() -> dict[str, float]:
    """Width of a point's image 400 mm below the scan, against that of the beam itself."""
    echoes = echoes_of_scan(np.zeros((1, 3)), None)
    fine = VoxelGrid(np.eye(4), (-40.0, -40.0, 0.0), (0.5, 40.0, 1.0), (1, 3, 161))
    deep = VoxelGrid(np.eye(4), (0.0, 0.0, -120.0), (1.0, 1.0, 1.0), (241, 1, 1))
    image = delay_and_sum(echoes, fine, "gather", coherence=True)
    column = delay_and_sum(echoes, deep, "gather").magnitude()[:, 0, 0]
    aside = np.linspace(-400, 400, 1601)
    far = np.column_stack([aside, np.zeros((1601, 1)), np.full(1601, HEIGHT_MM)])
    beam = width_mm(aside, np.abs(heard(far, np.zeros(3))[1]).mean(axis=1))
    lateral = width_mm(fine.x_mm, image.magnitude()[0, 1])
    weighted = width_mm(fine.x_mm, image.magnitude(weighted=True)[0, 1])
    print(
        f"\nA point 400 mm below the scan, -6 dB: lateral {lateral:.2f} mm (with coherence {weighted:.2f}), axial "
        f"{width_mm(deep.z_mm, column):.0f} mm; the beam itself {beam:.0f} mm (scan {PITCH_MM * (POSES - 1):.0f} mm)"
    )
    return {"lateral_mm_400": lateral}


def imaging_rows() -> dict[str, float]:
    """All figures of the acoustic images, printed beside their peers and what is asked."""
    figures = speed_rows()
    pymust_lines()
    figures |= peak_rows() | lateral_rows()
    print(f"\n{'images':28}{'measured':>10}{'asked':>10}{'aim':>8}")
    for key, (bar, aim) in TARGETS.items():
        measured = f"{figures[key]:10.6g}" if key in figures else "  no cc"
        print(f"{key:28}{measured}{bar:10g}{aim:8g}")
    return figures
