"""Lobes of one envelope: where they lie, how high they are, and the energy of each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import require_shape


@dataclass(frozen=True)
class Lobe:
    """One hump of an envelope; indices are samples, `stop` is exclusive."""

    start: int
    peak: int
    stop: int
    height: float
    energy: float


def peaks_above(envelope: NDArray[np.float32], threshold: float) -> NDArray[np.intp]:
    """Local maxima of an envelope (samples,) that reach the threshold; a plateau counts once, at its first sample."""
    require_shape("envelope", envelope, (None,))
    inner = envelope[1:-1]
    found = (inner >= threshold) & (inner > envelope[:-2]) & (inner >= envelope[2:])
    return np.flatnonzero(found) + 1


def lobes(envelope: NDArray[np.float32], threshold: float, sample_rate_hz: float, dip: float = 0.7) -> list[Lobe]:
    """Divide an envelope into lobes at its valleys, with the energy below each.

    Parameters
    ----------
    envelope : (samples,) float32
    threshold : float
        Lobes lower than this are not counted, and each lobe ends where the envelope falls below it.
    sample_rate_hz : float
    dip : float
        Two neighbouring maxima are two lobes only if the valley between them is below `dip` of the lower one.

    References
    ----------
    The paper, section 3.2 and equation 8 per lobe.
    """
    maxima = [int(p) for p in peaks_above(envelope, threshold)]
    kept: list[int] = []
    for peak in maxima:
        if kept:
            valley = float(envelope[kept[-1] : peak].min())
            if valley > dip * min(float(envelope[kept[-1]]), float(envelope[peak])):
                if envelope[peak] > envelope[kept[-1]]:
                    kept[-1] = peak
                continue
        kept.append(peak)
    out: list[Lobe] = []
    below = np.flatnonzero(envelope < threshold)
    for k, peak in enumerate(kept):
        before, after = below[below < peak], below[below > peak]
        start = int(before[-1]) + 1 if before.size else 0
        stop = int(after[0]) if after.size else envelope.shape[0]
        if k > 0:
            start = max(start, kept[k - 1] + int(np.argmin(envelope[kept[k - 1] : peak])))
        if k + 1 < len(kept):
            stop = min(stop, peak + int(np.argmin(envelope[peak : kept[k + 1]])))
        piece = envelope[start:stop].astype(np.float64)
        out.append(Lobe(start, peak, stop, float(envelope[peak]), float(np.sum(piece**2) / sample_rate_hz)))
    return out
