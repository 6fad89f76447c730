"""The few functions of the path whose combinations are all echoes of a band within some range of paths."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from echolume_messages.geometry import require_shape

NOISE = 5.0
"""Percentile of the band's power that counts as noise."""


class EchoBasis:
    """Karhunen-Loeve functions of echoes with the mean power spectrum of some signals.

    Parameters
    ----------
    signals : (poses, receivers, samples) complex64
        Baseband; only its power spectrum matters, not where or how strong the echoes are.
    width : float
        Full width of their band, waves per sample; what lies outside is no echo.
    turn_rad : float
        Carrier's phase from sample to sample.
    phase_rad : float
        Carrier's phase at sample 0.
    lost : float
        Share of an echo's energy that may be left out.

    Notes
    -----
    A band B over a range of paths R needs about R B + 3 functions (B in waves per mm of path), whatever the number of
    samples or echoes. Between samples the functions follow from the covariance, so there is no interpolation error.
    """

    def __init__(
        self, signals: NDArray[np.complex64], width: float, turn_rad: float, phase_rad: float, lost: float
    ) -> None:
        require_shape("signals", signals, (None, None, None))
        self._samples = signals.shape[2]
        self._lost = lost
        self._turn_rad = turn_rad
        self._phase_rad = phase_rad
        self.fine = max(16, int(np.ceil(10 * abs(turn_rad))))
        """Entries of a table per sample: the carrier turns by a tenth of a radian between two."""
        power = np.zeros(2 * self._samples)
        for pose in signals:
            power += np.sum(np.abs(np.fft.fft(pose, 2 * self._samples, axis=1)) ** 2, axis=0)
        outside = np.abs(np.fft.fftfreq(len(power))) > 0.5 * width + 0.5 / self._samples
        # White noise has no place in the spectrum of an echo: it would ask for a function per sample.
        power = np.maximum(power - np.percentile(power[~outside], NOISE), 0)
        power[outside] = 0
        self._lags = self._covariance(power / max(float(power.sum()), np.finfo(np.float64).tiny))

    def over(self, first: float, last: float) -> tuple[NDArray[np.complex64], NDArray[np.complex64], int]:
        """Functions for the samples from `first` to `last`.

        Returns
        -------
        analysis : (functions, n) complex64
            Coefficients are `analysis` times the n samples that begin at `start`.
        table : (entries, functions) complex64
            Functions times the carrier, `fine` entries per sample from `start` on; the outermost entries are 0.
        start : int
            No functions at all if the range lies outside the signals, or these are all silent.
        """
        start, end = max(0, int(np.floor(first)) - 1), min(self._samples - 1, int(np.ceil(last)) + 1)
        count = end - start + 1
        if count < 2 or not self._lags[0].real > 0:
            return np.zeros((0, 1), np.complex64), np.zeros((0, 0), np.complex64), 0
        column = self._lags[: count * self.fine : self.fine]
        strength, vectors = linalg.eigh(linalg.toeplitz(column, column.conj()))
        strength, vectors = strength[::-1], vectors[:, ::-1]
        left = 1 - np.cumsum(strength) / strength.sum()
        kept = int(np.argmax(left <= self._lost)) + 1 if left.min() <= self._lost else count
        entries = (count - 1) * self.fine + 1
        middle = len(self._lags) - 1
        sides = np.concatenate([self._lags[:0:-1].conj(), self._lags])
        lags = np.stack([sides[middle - k : middle - k + entries] for k in range(0, count * self.fine, self.fine)])
        table = np.zeros((entries + 2, kept), dtype=np.complex128)
        table[:entries] = lags.T @ (vectors[:, :kept] / strength[:kept])
        phase = self._phase_rad + self._turn_rad * (start + np.arange(entries) / self.fine)
        table[:entries] *= np.exp(1j * phase)[:, None]
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
