"""One grey frame for the stripe search: laser on minus laser off, and the colour channel that is not clipped."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import require_shape
from echolume_messages.types import Frame
from echolume_processing.optical.stripe import SATURATED_PART, extract

Pixel = TypeVar("Pixel", np.uint8, np.uint16)

PEDESTAL_PART = 1 / 16
"""What stays of full scale under a difference of equal frames, so that noise may fall on both sides."""
CLIPPED_SHARE = 0.02
"""Rows of a stripe that may be clipped before a channel counts as saturated."""


def difference(lit: NDArray[Pixel], dark: NDArray[Pixel], bits: int | None = None) -> NDArray[Pixel]:
    """Laser-on frame minus laser-off frame, on a pedestal.

    Parameters
    ----------
    lit, dark : (rows, columns) uint8 or uint16
        The same view with the laser on and off.
    bits : int, optional
        Bits of a pixel that are used: 8 for uint8, 12 for uint16 if not given.

    Returns
    -------
    (rows, columns) of the same type
        ``lit - dark`` plus a sixteenth of full scale, held within 0 and full scale. Where `lit` is clipped the
        difference is unknown and stays at full scale, so that the stripe keeps its saturation flag.

    Raises
    ------
    ValueError
        If the frames differ in shape or type.
    """
    require_shape("lit", lit, (None, None))
    if lit.shape != dark.shape or lit.dtype != dark.dtype:
        raise ValueError(f"dark: expected {lit.shape} {lit.dtype} like lit, got {dark.shape} {dark.dtype}")
    full = (1 << (bits if bits is not None else (8 if lit.itemsize == 1 else 12))) - 1
    wide = lit.astype(np.int32) - dark + round(full * PEDESTAL_PART)
    wide[lit >= full * SATURATED_PART] = full
    return np.clip(wide, 0, full).astype(lit.dtype)


def stripe_channel(image: NDArray[np.uint8]) -> int:
    """Which colour channel shows the stripe best without clipping it.

    Parameters
    ----------
    image : (rows, columns, channels) uint8
        A colour frame.

    Returns
    -------
    int
        Of the channels whose stripe is clipped in at most 2 % of its rows the one of largest summed stripe height;
        the least clipped one if there is none such.

    Notes
    -----
    A red laser clips the red channel long before the others, which still see it at a tenth of the light: a clipped
    channel that looks brighter measures worse.
    """
    require_shape("image", image, (None, None, None))
    scores: list[tuple[bool, float, float]] = []
    for k in range(image.shape[2]):
        found = extract(np.ascontiguousarray(image[:, :, k]), 1)
        seen = np.isfinite(found.column_px[:, 0])
        clipped = float(np.mean(found.saturated[seen, 0])) if seen.any() else 0.0
        height = float(np.sum(found.amplitude_dn[seen, 0]))
        usable = clipped <= CLIPPED_SHARE and bool(seen.any())
        scores.append((usable, 0.0 if usable else (-clipped if seen.any() else -2.0), height))
    return max(range(len(scores)), key=scores.__getitem__)


def grey(image: NDArray[np.uint8]) -> Frame:
    """The channel of a colour frame that `stripe_channel` chooses, (rows, columns) uint8."""
    return np.ascontiguousarray(image[:, :, stripe_channel(image)])
