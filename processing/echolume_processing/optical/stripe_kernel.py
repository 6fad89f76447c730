"""The compiled pass over a frame: where each row's peaks stand out, and the measurement of each.

The frame is read once, as words of two pixels. Shifted views share one index and each reduction stands alone: only
then does the compiler use whole vector registers.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from echolume_processing.optical.stripe_measure import (
    COLUMN,
    FLANK_PX,
    MIDDLE,
    RESULTS,
    WINDOW,
    Pixels,
    Values,
    measure,
)
from echolume_processing.optical.stripe_words import compiled, mean, mean_of_two, placed

Words = NDArray[Any]
"""Two pixels each."""
FLANK = FLANK_PX // 2
PAD = FLANK + 1
BLOCK_BITS = 7
BLOCK = 1 << BLOCK_BITS
"""Pairs whose largest possible response is bounded together."""
ROWS = 8
"""Rows that are prepared together, so that no pair is loaded while it is still being stored."""
CHUNKS = 4
CHUNK = 64
NOISE_DIFFERENCE = 1.1284
"""Mean absolute difference of two normal samples of unit sigma."""
NOISE_LARGEST_LEFT_OUT = 0.978
"""What leaving out the largest of four estimates of 64 samples leaves of the mean."""
MIN_NOISE_DN = 0.3
FLOOR_SIGMAS = 0.5
"""The brighter flank of a box is seldom further below the block's mean."""
REJECTED = 8
"""Peaks of a row that may turn out to be none before the row is given up."""
EXACT = np.uint32(1 << 15)


@compiled
def _pairs(words: Words, out: Pixels, largest: Pixels) -> None:
    """Mean of each word's two pixels, and the largest of each block of them."""
    for k in range(len(largest)):
        base = np.uintp(k * BLOCK)  # an unsigned index needs no test for counting from the end
        high = mean_of_two(words[base])
        for i in range(BLOCK):
            at = np.uintp(base + np.uintp(i))
            value = mean_of_two(words[at])
            out[at] = value
            high = max(high, value)
        largest[k] = high


@compiled
def _floors(pairs: Pixels, margin: float, floors: NDArray[np.int32]) -> None:
    """What the flanks of each block's boxes hardly fall below: the mean of the darkest block around, less a margin."""
    blocks = len(floors) // 2
    for k in range(blocks):
        p = pairs[k * BLOCK : k * BLOCK + BLOCK]
        total = np.int32(0)
        for i in range(BLOCK):
            total = np.int32(total + np.int32(p[i]))
        floors[blocks + k] = np.int32(total // BLOCK)
    for k in range(blocks):
        around = min(floors[blocks + max(k - 1, 0)], floors[blocks + min(k + 1, blocks - 1)])
        floors[k] = np.int32(min(floors[blocks + k], around) - np.int32(margin))


@compiled
def _respond(pairs: Pixels, out: Pixels) -> None:
    """How far a box of four pixels stands above the brighter of its flanks."""
    l0, l1 = pairs[0:], pairs[1:]
    m0, m1 = pairs[FLANK:], pairs[FLANK + 1 :]
    r0, r1 = pairs[2 * FLANK :], pairs[2 * FLANK + 1 :]
    for i in range(BLOCK):
        flank = max(mean(l0[i], l1[i]), mean(r0[i], r1[i]))
        out[i] = max(mean(m0[i], m1[i]), flank) - flank


@compiled
def _strongest(response: Pixels) -> np.uint32:
    """Largest response of a block with its place: response << 8 | place."""
    best = placed(response[0], 0)
    for i in range(BLOCK):
        best = max(best, placed(response[i], i))
    return np.uint32(best)


@compiled
def _busy(row: Pixels, start: int) -> np.int32:
    """Sum of the absolute differences of neighbours over CHUNK pixels."""
    a = row[start : start + CHUNK]
    b = row[start + 1 : start + 1 + CHUNK]
    total = np.int32(0)
    for i in range(CHUNK):
        total = np.int32(total + np.int32(abs(np.int32(np.int32(a[i]) - np.int32(b[i])))))
    return total


@compiled
def _noise(row: Pixels) -> float:
    """Sigma of a row's noise from neighbouring differences in four places; the busiest of them is left out."""
    columns = len(row)
    if columns <= CHUNKS * CHUNK:
        total = 0.0
        for i in range(columns - 1):
            total += abs(float(row[i]) - float(row[i + 1]))
        return max(total / max(columns - 1, 1) / NOISE_DIFFERENCE, MIN_NOISE_DN)
    total = 0
    busiest = 0
    for k in range(CHUNKS):
        part = _busy(row, (columns * (2 * k + 1)) // (2 * CHUNKS) - CHUNK // 2)
        total += part
        busiest = max(busiest, part)
    usual = float(total - busiest) / ((CHUNKS - 1) * CHUNK)
    return max(usual / (NOISE_DIFFERENCE * NOISE_LARGEST_LEFT_OUT), MIN_NOISE_DN)


@compiled
def _cut(row: Pixels, start: int, window: Pixels) -> None:
    """Copy a window of the row, continued by the border's pixel outside the image."""
    if start >= 0 and start + WINDOW <= len(row):
        inside = row[start : start + WINDOW]
        for i in range(WINDOW):
            window[i] = inside[i]
    else:
        for i in range(WINDOW):
            window[i] = row[min(max(start + i, 0), len(row) - 1)]


@compiled
def _search(
    row: Pixels,
    pairs: Pixels,
    bounds: NDArray[np.uint32],
    order: NDArray[np.uint32],
    threshold: float,
    noise: float,
    full: float,
    weights: NDArray[np.int16],
    slope: Values,
    sigmas: Values,
    gains: Values,
    spreads: Values,
    response: Pixels,
    window: Pixels,
    taken: NDArray[np.uint32],
    values: Values,
    y: int,
    out: Values,
) -> None:
    """Best first: the block of the largest bound is looked into until a known response is the largest."""
    wanted = out.shape[2]
    found = 0
    gone = 0
    lowest = np.uint32(np.uint32(threshold) << np.uint32(16))
    while found < wanted and gone < wanted + REJECTED:
        best = np.uint32(0)
        for k in range(len(order)):
            best = max(best, order[k])
        if best <= lowest:
            break
        k = np.int64(best & np.uint32(255))
        if not best & EXACT:
            _respond(pairs[k * BLOCK + PAD - FLANK :], response)
            for i in range(gone):
                for j in range(
                    max(np.int64(taken[i]) - FLANK - k * BLOCK, 0),
                    min(np.int64(taken[i]) + FLANK + 1 - k * BLOCK, BLOCK),
                ):
                    response[j] = 0
            strongest = np.uint32(_strongest(response))
            place = np.uint32(strongest & np.uint32(BLOCK - 1))
            value = np.uint32(strongest >> np.uint32(8))
            order[k] = np.uint32(value << np.uint32(16)) | EXACT | np.uint32(place << np.uint32(8)) | np.uint32(k)
            continue
        at = int(k * BLOCK + np.int64(np.uint32(best >> np.uint32(8)) & np.uint32(BLOCK - 1)))
        start = 2 * at + 1 - MIDDLE
        _cut(row, start, window)
        good = measure(window, noise, full, weights, slope, sigmas, gains, spreads, values)
        values[COLUMN] += start
        if good and 0 <= values[COLUMN] <= len(row) - 1:
            for i in range(RESULTS):
                out[i, y, found] = values[i]
            found += 1
            if found == wanted:
                return
        taken[gone] = at
        gone += 1
        for i in range(max(at - FLANK, 0) >> BLOCK_BITS, min((at + FLANK) >> BLOCK_BITS, len(order) - 1) + 1):
            order[i] = bounds[i] if i != k else np.uint32(np.uint32(best & np.uint32(0xFFFF0000)) | np.uint32(i))
    for k in range(found, wanted):
        for i in range(RESULTS):
            out[i, y, k] = np.nan


@compiled
def extract_rows(
    frame: Pixels,
    words: Words,
    pixels: Pixels,
    tail: Words,
    notes: NDArray[np.uint32],
    floors: NDArray[np.int32],
    values: Values,
    full: float,
    threshold_sigmas: float,
    threshold_dn: float,
    weights: NDArray[np.int16],
    slope: Values,
    sigmas: Values,
    gains: Values,
    spreads: Values,
    out: Values,
    noise: Values,
) -> None:
    """Fill `out` (RESULTS, rows, candidates) and `noise` (rows,).

    `words` holds the frame two pixels at a time; `scratch` gives the memory to work in. Noise and background are
    taken from two of each ROWS rows.
    """
    rows = frame.shape[0]
    whole = words.shape[1] // BLOCK
    blocks = whole + (1 if words.shape[1] % BLOCK else 0)
    stride = blocks * BLOCK + 2 * PAD + BLOCK
    used = ROWS * stride
    high = pixels[used : used + ROWS * blocks]
    response = pixels[used + ROWS * blocks :][:BLOCK]
    window = pixels[used + ROWS * blocks + BLOCK :]
    bounds = notes[:blocks]
    order = notes[blocks : 2 * blocks]
    taken = notes[2 * blocks :]
    for first in range(0, rows, ROWS):
        count = min(ROWS, rows - first)
        for y in range(count):
            padded = pixels[y * stride : y * stride + stride]
            inner = padded[PAD:]
            _pairs(words[first + y], inner, high[y * blocks : y * blocks + whole])
            if whole < blocks:
                for i in range(BLOCK):
                    tail[i] = words[first + y, min(whole * BLOCK + i, words.shape[1] - 1)]
                _pairs(tail, inner[whole * BLOCK :], high[y * blocks + whole : y * blocks + blocks])
            border = inner[0]
            for i in range(PAD):
                padded[i] = border
            border = inner[blocks * BLOCK - 1]
            for i in range(PAD):
                inner[blocks * BLOCK + i] = border
        middle = count // 2
        sigma = 0.5 * (_noise(frame[first]) + _noise(frame[first + middle]))
        threshold = max(threshold_sigmas * sigma, threshold_dn)
        for y in range(count):
            padded = pixels[y * stride : y * stride + stride]
            if y in (0, middle):
                _floors(padded[PAD:], FLOOR_SIGMAS * sigma, floors)
            noise[first + y] = sigma
            h = high[y * blocks : y * blocks + blocks]
            for k in range(blocks):
                # The last box reaches into the next block.
                brightest = np.int32(max(h[k], padded[PAD + (k + 1) * BLOCK]))
                bound = np.uint32(max(np.int32(brightest - floors[k]), np.int32(0)))
                bounds[k] = np.uint32(np.uint32(bound << np.uint32(16)) | np.uint32(k))
                order[k] = bounds[k]
            _search(
                frame[first + y], padded, bounds, order, threshold, sigma, full,
                weights, slope, sigmas, gains, spreads, response, window, taken, values, first + y, out,
            )  # fmt: skip


def scratch(words: Words, candidates: int) -> tuple[Pixels, Words, NDArray[np.uint32], NDArray[np.int32], Values]:
    """Memory that the kernel works in: pixels, one block of words, notes, floors and one peak."""
    blocks = -(-words.shape[1] // BLOCK)
    pixel = np.uint8 if words.dtype == np.uint16 else np.uint16
    return (
        np.empty(ROWS * (blocks * BLOCK + 2 * PAD + BLOCK + blocks) + BLOCK + WINDOW, pixel),
        np.empty(BLOCK, words.dtype),
        np.empty(2 * blocks + candidates + REJECTED, np.uint32),
        np.empty(2 * blocks, np.int32),
        np.empty(RESULTS, np.float64),
    )
