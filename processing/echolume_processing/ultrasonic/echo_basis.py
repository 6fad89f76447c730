"""The few functions of the path whose combinations are all echoes of a band within some range of paths."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from echolume_messages.geometry import require_shape

LOST = 3e-4
"""Share of an echo's energy that the functions may leave out: a few thousandths of the amplitude of a sum."""
NOISE = 5.0
"""Percentile of the band's power that counts as noise."""


class EchoBasis:
    """Karhunen-Loeve functions of echoes with the mean power spectrum of some signals.

    Parameters
    ----------
    signals : (poses, receivers, samples) complex64
        Baseband; only its power spectrum matters, not where or how strong the echoes are.
    first_mm, step_mm : float
        Path of sample 0, and from sample to sample.
    width_rad : float
        Full width of their band, rad from sample to sample; what lies outside is no echo.
    wavenumber : float
        Of the carrier, rad/mm.

    Notes
    -----
    A band B over a range of paths R needs about R B + 3 functions (B in waves per mm of path), whatever the number of
    samples or echoes. Between samples the functions follow from the covariance, so there is no interpolation error.
    """

    def __init__(
        self, signals: NDArray[np.complex64], first_mm: float, step_mm: float, width_rad: float, wavenumber: float
    ) -> None:
        require_shape("signals", signals, (None, None, None))
        self._samples = signals.shape[2]
        self._first_mm = first_mm
        self._step_mm = step_mm
        self._wavenumber = wavenumber
        self.fine = max(16, int(np.ceil(10 * wavenumber * step_mm)))
        """Entries of a table per sample: the carrier turns by a tenth of a radian between two."""
        power = np.zeros(2 * self._samples)
        for pose in signals:
            power += np.sum(np.abs(np.fft.fft(pose, 2 * self._samples, axis=1)) ** 2, axis=0)
        outside = np.abs(np.fft.fftfreq(len(power))) > width_rad / (4 * np.pi) + 0.5 / self._samples
        # White noise has no place in the spectrum of an echo: it would ask for a function per sample.
        power = np.maximum(power - np.percentile(power[~outside], NOISE), 0)
        power[outside] = 0
        self._lags = self._covariance(power / max(float(power.sum()), np.finfo(np.float64).tiny))

    def over(self, shortest_mm: float, longest_mm: float) -> tuple[NDArray[np.complex64], NDArray[np.complex64], int]:
        """Functions for a range of paths.

        Returns
        -------
        analysis : (functions, n) complex64
            Coefficients are `analysis` times the n samples that begin at `start`.
        table : (entries, functions) complex64
            Functions times the carrier, `fine` entries per sample from `start` on; the outermost entries are 0.
        start : int
            No functions at all if the range lies outside the signals, or these are all silent.
        """
        first, last = ((path - self._first_mm) / self._step_mm for path in (shortest_mm, longest_mm))
        # The table's outermost entries are no paths, so the first one lies before the range.
        start, end = max(0, int(np.floor(first - 1 / self.fine))), min(self._samples - 1, int(np.ceil(last)))
        count = end - start + 1
        if count < 2 or not self._lags[0].real > 0:
            return np.zeros((0, 1), np.complex64), np.zeros((0, 0), np.complex64), 0
        column = self._lags[: count * self.fine : self.fine]
        strength, vectors = linalg.eigh(linalg.toeplitz(column, column.conj()))
        strength, vectors = strength[::-1], vectors[:, ::-1]
        left = 1 - np.cumsum(strength) / strength.sum()
        kept = int(np.argmax(left <= LOST)) + 1 if left.min() <= LOST else count
        entries = (count - 1) * self.fine + 1
        middle = len(self._lags) - 1
        sides = np.concatenate([self._lags[:0:-1].conj(), self._lags])
        lags = np.stack([sides[middle - k : middle - k + entries] for k in range(0, count * self.fine, self.fine)])
        table = np.zeros((entries + 2, kept), dtype=np.complex128)
        table[:entries] = lags.T @ (vectors[:, :kept] / strength[:kept])
        path_mm = self._first_mm + self._step_mm * (start + np.arange(entries) / self.fine)
        table[:entries] *= np.exp(1j * self._wavenumber * path_mm)[:, None]
        table[0] = 0
        return vectors[:, :kept].conj().T.astype(np.complex64), table.astype(np.complex64), start

    def _covariance(self, power: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Covariance of two values by the distance between them in entries, (samples * fine,)."""
        length = len(power)
        spectrum = np.zeros(length * self.fine, dtype=np.float64)
        half = length // 2
        spectrum[:half] = power[:half]
        spectrum[-half:] = power[half:]
        return np.fft.ifft(spectrum)[: self._samples * self.fine] * len(spectrum)
