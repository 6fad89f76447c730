"""Which candidates are believed: both cameras agree, or nothing contradicts and the run of neighbours is convincing."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numba import njit
from numpy.typing import NDArray

from echolume_processing.optical.candidates import Candidates
from echolume_processing.optical.correspond import Match

Values = NDArray[np.float64]
Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]
Verdicts = NDArray[np.uint8]


class Verdict(IntEnum):
    """What became of a candidate; from OUTSIDE on it was rejected."""

    BOTH = 0
    """Both cameras see it where the laser plane predicts it."""
    ALONE = 1
    """Only this camera sees it, the other one may be occluded."""
    OUTSIDE = 2
    """Beyond the gates of height and width."""
    SECONDARY = 3
    """Both cameras agree on another point of the same row."""
    CONTRADICTED = 4
    """The other camera sees something else there, about as bright."""
    ODD = 5
    """Much wider or narrower than the stripe elsewhere."""
    WEAK = 6
    """Much darker than the stripe elsewhere."""
    SHORT = 7
    """Too few neighbouring rows agree."""


# Plain numbers for the compiled code.
_BOTH, _ALONE, _OUTSIDE, _SECONDARY, _CONTRADICTED, _ODD, _WEAK, _SHORT = (int(v) for v in Verdict)

WIDTH_LOG = 0.45
"""Largest |log| of a lone candidate's width over the usual width."""
LEAST_OF_USUAL = 0.4
"""Least amplitude of a lone candidate over the usual one."""
RIVAL = 2.0
"""A lone candidate must be this much brighter than what the other camera sees on the same row."""
CONTINUITY_MM, CONTINUITY_PER_ROW_MM = 0.8, 0.3
"""Heights of one surface differ by less from row to row, and by so much more for each row between."""
GAP_ROWS = 3
"""A run may miss this many rows less one."""
LEAST_AGREED_ROWS = 3
SURE_ROWS = 40
"""Longer runs are not better."""
LEAST_OFF_PX, OFF_SIGMAS = 0.7, 4.5
"""How far a pair may lie from where the plane predicts it, besides what all pairs of the stripe have in common."""
FEW = 20


@njit(cache=True, nogil=True)
def _chain(start: Indices, row: Indices, z: Values, allowed: Flags, before: Indices, after: Indices) -> None:
    """Rows of the longest smooth run of allowed candidates that ends (`before`) or begins (`after`) at each."""
    rows = len(start) - 1
    before[:] = 0
    after[:] = 0
    for n in range(len(row)):
        if not allowed[n]:
            continue
        longest = 0
        for gap in range(1, min(GAP_ROWS, row[n]) + 1):
            limit = CONTINUITY_MM + CONTINUITY_PER_ROW_MM * (gap - 1)
            for m in range(start[row[n] - gap], start[row[n] - gap + 1]):
                if allowed[m] and before[m] > longest and abs(z[m] - z[n]) < limit:
                    longest = before[m]
        before[n] = longest + 1
    for n in range(len(row) - 1, -1, -1):
        if not allowed[n]:
            continue
        longest = 0
        for gap in range(1, min(GAP_ROWS, rows - 1 - row[n]) + 1):
            limit = CONTINUITY_MM + CONTINUITY_PER_ROW_MM * (gap - 1)
            for m in range(start[row[n] + gap], start[row[n] + gap + 1]):
                if allowed[m] and after[m] > longest and abs(z[m] - z[n]) < limit:
                    longest = after[m]
        after[n] = longest + 1


@njit(cache=True, nogil=True)
def _agree(
    start: Indices, row: Indices, z: Values, amplitude: Values, partner: Indices, off: Values, verdict: Verdicts,
    agreed: Flags, row_agreed: Flags, before: Indices, after: Indices,
) -> None:  # fmt: skip
    """Of the candidates that the other camera supports choose one a row: the one of the longest run."""
    matched = off[partner >= 0]
    middle, limit = 0.0, LEAST_OFF_PX + 0.5
    if len(matched) >= FEW:
        middle = np.median(matched)
        limit = max(LEAST_OFF_PX, OFF_SIGMAS * 1.4826 * np.median(np.abs(matched - middle)))
    for n in range(len(row)):
        verdict[n] = _OUTSIDE if np.isnan(z[n]) else _SHORT
        agreed[n] = partner[n] >= 0 and abs(off[n] - middle) < limit
    _chain(start, row, z, agreed, before, after)
    for r in range(len(start) - 1):
        best, chosen = 0.0, -1
        for n in range(start[r], start[r + 1]):
            if agreed[n]:
                length = before[n] + after[n] - 1
                score = min(length, SURE_ROWS) * 1000.0 + amplitude[n]
                if length >= LEAST_AGREED_ROWS and score > best:
                    best, chosen = score, n
                agreed[n] = False
        row_agreed[r] = chosen >= 0
        if chosen >= 0:
            agreed[chosen] = True
            verdict[chosen] = _BOTH


@njit(cache=True, nogil=True)
def _usual(values: Values, agreed: Flags) -> float:
    chosen = values[agreed]
    return np.median(chosen) if len(chosen) >= FEW else np.nan


@njit(cache=True, nogil=True)
def _lone(
    start: Indices, row: Indices, z: Values, width: Values, amplitude: Values, expected_row: Values,
    agreed: Flags, row_agreed: Flags, other_agreed: Flags, verdict: Verdicts, alone: Flags,
) -> None:  # fmt: skip
    """Of the candidates of rows without agreement choose the brightest that looks like the stripe."""
    usual_px, usual_dn = _usual(width, agreed), _usual(amplitude, agreed)
    for r in range(len(start) - 1):
        best, chosen = 0.0, -1
        for n in range(start[r], start[r + 1]):
            alone[n] = False
            if agreed[n] or np.isnan(z[n]):
                continue
            seen = expected_row[n]
            at = round(seen) if -1.0 < seen < len(other_agreed) else -1
            if row_agreed[r] or (0 <= at < len(other_agreed) and other_agreed[at]):
                verdict[n] = _SECONDARY
            elif abs(np.log(width[n] / usual_px)) > WIDTH_LOG:
                verdict[n] = _ODD
            elif amplitude[n] < LEAST_OF_USUAL * usual_dn:
                verdict[n] = _WEAK
            elif amplitude[n] > best:
                best, chosen = amplitude[n], n
        if chosen >= 0:
            alone[chosen] = True


@njit(cache=True, nogil=True)
def _brightest(start: Indices, amplitude: Values, alone: Flags, out: Values) -> None:
    for r in range(len(start) - 1):
        out[r] = 0.0
        for n in range(start[r], start[r + 1]):
            if alone[n]:
                out[r] = amplitude[n]


@njit(cache=True, nogil=True)
def _believe(
    start: Indices, row: Indices, z: Values, amplitude: Values, expected_row: Values, rival: Values, run_rows: int,
    agreed: Flags, alone: Flags, verdict: Verdicts, before: Indices, after: Indices,
) -> None:  # fmt: skip
    """Keep lone candidates that the other camera does not contradict and that run on for long enough."""
    for n in range(len(row)):
        if alone[n]:
            seen = expected_row[n]
            at = round(seen) if -1.0 < seen < len(rival) else -1
            if 0 <= at < len(rival) and amplitude[n] < RIVAL * rival[at]:
                verdict[n] = _CONTRADICTED
                alone[n] = False
    _chain(start, row, z, agreed | alone, before, after)
    for n in range(len(row)):
        if alone[n] and before[n] + after[n] - 1 >= run_rows:
            verdict[n] = _ALONE


def choose(sides: tuple[Candidates, Candidates], matches: tuple[Match, Match], run_rows: int) -> tuple[Verdicts, ...]:
    """Judge all candidates; at most one a row is believed in each camera.

    Parameters
    ----------
    sides : two of Candidates
        Left and right.
    matches : two of Match
        What the other camera says to each.
    run_rows : int
        Rows that must agree where the other camera gives no support.

    Returns
    -------
    two of (n,) uint8
        `Verdict` of each candidate.

    Notes
    -----
    Laser ray and image row of a point nearly coincide in the laser plane, so a row holds one lit point: where both
    cameras agree on a point of that row, every other candidate of the row, in either camera, is a reflection.
    """
    verdicts = tuple(np.empty(len(s.row), dtype=np.uint8) for s in sides)
    agreed, alone = (tuple(np.empty(len(s.row), dtype=np.bool_) for s in sides) for _ in range(2))
    row_agreed = tuple(np.empty(s.rows, dtype=np.bool_) for s in sides)
    runs = tuple(np.empty((2, len(s.row)), dtype=np.int64) for s in sides)
    for i in (0, 1):
        s, m = sides[i], matches[i]
        _agree(
            s.start, s.row, s.active_mm[2], s.measured[3], m.partner, m.off_px, verdicts[i], agreed[i],
            row_agreed[i], runs[i][0], runs[i][1],
        )  # fmt: skip
    for i in (0, 1):
        s = sides[i]
        _lone(
            s.start, s.row, s.active_mm[2], s.measured[2], s.measured[3], s.expected_px[1], agreed[i],
            row_agreed[i], row_agreed[1 - i], verdicts[i], alone[i],
        )  # fmt: skip
    rivals = tuple(np.empty(s.rows) for s in sides)
    for i in (0, 1):
        _brightest(sides[i].start, sides[i].measured[3], alone[i], rivals[i])
    for i in (0, 1):
        s = sides[i]
        _believe(
            s.start, s.row, s.active_mm[2], s.measured[3], s.expected_px[1], rivals[1 - i], run_rows, agreed[i],
            alone[i], verdicts[i], runs[i][0], runs[i][1],
        )  # fmt: skip
    return verdicts
