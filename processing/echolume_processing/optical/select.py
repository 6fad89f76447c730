"""Which candidates are believed: both cameras agree, or nothing contradicts and the run of neighbours is convincing."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numba import njit
from numpy.typing import NDArray

from echolume_processing.optical.candidates import Candidates
from echolume_processing.optical.epipolar import Match
from echolume_processing.optical.middle import median

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
    FADING = 8
    """Less than half as bright as its run, at the run's end: the lens blurs it beyond where the surface ends."""


# Plain numbers for the compiled code.
_BOTH, _ALONE, _OUTSIDE, _SECONDARY, _CONTRADICTED, _ODD, _WEAK, _SHORT, _FADING = (int(v) for v in Verdict)
LAST_BELIEVED = int(Verdict.ALONE)
VERDICTS = len(Verdict)

WIDTH_LOG = 0.45
"""Largest |log| of a lone candidate's width over the usual width."""
LEAST_OF_USUAL = 0.5
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
BRIGHTER = 1e5
"""A row more counts more than any amplitude."""
FADED_ROWS = 4
"""The blur reaches no further beyond the end of a surface."""
FALLS = 0.8
"""And falls by more from row to row; a darker rim does not."""
USUAL_ROWS = 6
"""So many rows further in tell how bright a run is; at its very end it is half as bright."""
FEW = 20
LAG_ROWS = 4
"""Rows so far apart do not share their speckle grain."""


@njit(cache=True, nogil=True)
def _run_rows(start: Indices, row: Indices, z: Values, allowed: Flags) -> Indices:
    """Rows of the longest smooth run of allowed candidates through each, 0 where it is not allowed itself."""
    rows = len(start) - 1
    length = np.zeros(len(row), np.int64)  # of the run that ends here, then of the whole
    after = np.zeros(len(row), np.int64)
    for n in range(len(row)):
        if allowed[n]:
            longest = 0
            for gap in range(1, min(GAP_ROWS, row[n]) + 1):
                limit = CONTINUITY_MM + CONTINUITY_PER_ROW_MM * (gap - 1)
                for m in range(start[row[n] - gap], start[row[n] - gap + 1]):
                    if length[m] > longest and abs(z[m] - z[n]) < limit:
                        longest = length[m]
                if longest > 0:
                    break
            length[n] = longest + 1
    for n in range(len(row) - 1, -1, -1):
        if allowed[n]:
            longest = 0
            for gap in range(1, min(GAP_ROWS, rows - 1 - row[n]) + 1):
                limit = CONTINUITY_MM + CONTINUITY_PER_ROW_MM * (gap - 1)
                for m in range(start[row[n] + gap], start[row[n] + gap + 1]):
                    if after[m] > longest and abs(z[m] - z[n]) < limit:
                        longest = after[m]
                if longest > 0:
                    break
            after[n] = longest + 1
    for n in range(len(row)):
        if allowed[n]:
            length[n] += after[n] - 1
    return length


@njit(cache=True, nogil=True)
def _agree(side: Candidates, match: Match) -> tuple[Verdicts, Flags]:
    """Of the candidates that the other camera supports choose one a row: the one of the longest run."""
    z, amplitude = side.active_mm[2], side.measured[3]
    off = match.off_px
    matched, count = np.empty(len(off)), 0
    for n in range(len(off)):
        if match.partner[n] >= 0:
            matched[count] = off[n]
            count += 1
    middle, limit = 0.0, LEAST_OFF_PX + 0.5
    if count >= FEW:
        middle = median(matched, count)
        for n in range(count):
            matched[n] = abs(matched[n] - middle)
        limit = max(LEAST_OFF_PX, OFF_SIGMAS * 1.4826 * median(matched, count))
    verdict, allowed = np.empty(len(z), np.uint8), np.empty(len(z), np.bool_)
    for n in range(len(z)):
        verdict[n] = _OUTSIDE if np.isnan(z[n]) else _SHORT
        allowed[n] = match.partner[n] >= 0 and abs(off[n] - middle) < limit
    for _ in range(2):
        length = _run_rows(side.start, side.row, z, allowed)
        for r in range(len(side.start) - 1):
            best, chosen = 0.0, -1
            for n in range(side.start[r], side.start[r + 1]):
                if verdict[n] == _BOTH:
                    verdict[n] = _SHORT
                score = min(length[n], SURE_ROWS) * BRIGHTER + amplitude[n]
                if length[n] >= LEAST_AGREED_ROWS and score > best:
                    best, chosen = score, n
            if chosen >= 0:
                verdict[chosen] = _BOTH
        if not _fade(side, verdict):
            break
        for n in range(len(z)):  # what is beside the end of a surface had no chance in its blur
            allowed[n] &= verdict[n] != _FADING
    row_agreed = np.zeros(len(side.start) - 1, np.bool_)
    for n in range(len(z)):
        row_agreed[side.row[n]] |= verdict[n] == _BOTH
    return verdict, row_agreed


@njit(cache=True, nogil=True)
def _beyond_dn(side: Candidates, one: int, step: int) -> float:
    """How bright the same surface is on the next row, believed or not; 0 if nothing is there."""
    brightest, r = 0.0, side.row[one] + step
    if 0 <= r < len(side.start) - 1:
        for m in range(side.start[r], side.start[r + 1]):
            if abs(side.active_mm[2, m] - side.active_mm[2, one]) < CONTINUITY_MM:
                brightest = max(brightest, side.measured[3, m])
    return brightest


@njit(cache=True, nogil=True)
def _fade(side: Candidates, verdict: Verdicts) -> bool:
    """Reject what is believed at the ends of runs and less than half as bright, and what goes on from there.

    Whether there was any.
    """
    rows, amplitude, z = len(side.start) - 1, side.measured[3], side.active_mm[2]
    believed, n = np.empty(rows, np.int64), 0
    for k in range(len(verdict)):
        if verdict[k] <= _ALONE:
            believed[n] = k
            n += 1
    any_faded = False
    for step in (1, -1):
        for i in range(n):
            k = believed[i]
            if 0 <= i - step < n and _goes_on(side, z, believed[i - step], k):
                continue
            limit, end = 0.5 * _usual_dn(side, believed[:n], i, step), believed[i]
            if np.isnan(limit):
                continue
            for j in range(FADED_ROWS):
                k = believed[i + step * j]
                if amplitude[k] >= limit or _beyond_dn(side, k, -step) > FALLS * amplitude[k]:
                    break
                verdict[k] = _FADING
                any_faded = True
            if verdict[end] != _FADING:
                continue
            for r in range(side.row[end] - step, side.row[end] - step * (FADED_ROWS + 1), -step):  # and further out
                if not 0 <= r < rows:
                    break
                for m in range(side.start[r], side.start[r + 1]):
                    if verdict[m] > _ALONE and abs(z[m] - z[end]) < CONTINUITY_MM and amplitude[m] < limit:
                        verdict[m] = _FADING
    return any_faded


@njit(cache=True, nogil=True)
def _usual_dn(side: Candidates, believed: Indices, end: int, step: int) -> float:
    """How bright a run is further in than blur reaches from its end; nan if it is too short to tell."""
    usual = np.empty(USUAL_ROWS)
    for j in range(1, FADED_ROWS + USUAL_ROWS + 1):
        m = end + step * j
        if not (0 <= m < len(believed) and _goes_on(side, side.active_mm[2], believed[m - step], believed[m])):
            return np.nan
        if j > FADED_ROWS:
            usual[j - FADED_ROWS - 1] = side.measured[3, believed[m]]
    return median(usual, USUAL_ROWS)


@njit(cache=True, nogil=True)
def _goes_on(side: Candidates, z: Values, one: int, other: int) -> bool:
    """Whether two believed candidates are neighbours on one surface."""
    gap = abs(side.row[other] - side.row[one])
    return gap <= GAP_ROWS and abs(z[one] - z[other]) < CONTINUITY_MM + CONTINUITY_PER_ROW_MM * (gap - 1)


@njit(cache=True, nogil=True)
def _usual(values: Values, verdict: Verdicts) -> float:
    """Median over what both cameras agree on, nan while that is little."""
    chosen, count = np.empty(len(values)), 0
    for n in range(len(values)):
        if verdict[n] == _BOTH:
            chosen[count] = values[n]
            count += 1
    return median(chosen, count) if count >= FEW else np.nan


@njit(cache=True, nogil=True)
def _at(rows: int, row: float) -> int:
    """The whole row nearest to `row`, -1 outside the image; nan is outside."""
    return round(row) if -0.5 < row < rows - 0.5 else -1


@njit(cache=True, nogil=True)
def _lone(side: Candidates, verdict: Verdicts, row_agreed: Flags, other_agreed: Flags) -> Flags:
    """Of the candidates of rows without agreement choose the brightest that looks like the stripe."""
    width, amplitude = side.measured[2], side.measured[3]
    usual_px, usual_dn = _usual(width, verdict), _usual(amplitude, verdict)
    alone = np.zeros(len(width), np.bool_)
    for r in range(len(row_agreed)):
        best, chosen = 0.0, -1
        for n in range(side.start[r], side.start[r + 1]):
            if verdict[n] != _SHORT:
                continue
            at = _at(len(other_agreed), side.expected_px[1, n])
            if row_agreed[r] or (at >= 0 and other_agreed[at]):
                verdict[n] = _SECONDARY
            elif abs(np.log(width[n] / usual_px)) > WIDTH_LOG:
                verdict[n] = _ODD
            elif amplitude[n] < LEAST_OF_USUAL * usual_dn:
                verdict[n] = _WEAK
            elif amplitude[n] > best:
                best, chosen = amplitude[n], n
        if chosen >= 0:
            alone[chosen] = True
    return alone


@njit(cache=True, nogil=True)
def _brightest(side: Candidates, alone: Flags) -> Values:
    """Amplitude of each row's lone candidate, 0 where there is none; (rows,)."""
    out = np.zeros(len(side.start) - 1)
    for n in range(len(alone)):
        if alone[n]:
            out[side.row[n]] = side.measured[3, n]
    return out


@njit(cache=True, nogil=True)
def _believe(side: Candidates, alone: Flags, rival_dn: Values, run_rows: int, verdict: Verdicts) -> None:
    """Keep lone candidates that the other camera does not contradict and that run on for long enough."""
    allowed, any_alone = np.empty(len(alone), np.bool_), False
    for n in range(len(alone)):
        if alone[n]:
            at = _at(len(rival_dn), side.expected_px[1, n])
            if at >= 0 and side.measured[3, n] < RIVAL * rival_dn[at]:
                verdict[n] = _CONTRADICTED
                alone[n] = False
        any_alone |= alone[n]
        allowed[n] = alone[n] or verdict[n] == _BOTH
    if any_alone:
        length = _run_rows(side.start, side.row, side.active_mm[2], allowed)
        for n in range(len(alone)):
            if alone[n] and length[n] >= run_rows:
                verdict[n] = _ALONE
        _fade(side, verdict)


@njit(cache=True, nogil=True)
def choose(
    left: Candidates, right: Candidates, to_right: Match, to_left: Match, run_rows: int
) -> tuple[Verdicts, Verdicts]:
    """Judge all candidates; at most one a row is believed in each camera. Compiled.

    Parameters
    ----------
    left, right : Candidates
        Of both cameras.
    to_right, to_left : Match
        What the other camera says to the candidates of the left and of the right one.
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
    first, rows_first = _agree(left, to_right)
    second, rows_second = _agree(right, to_left)
    alone_first = _lone(left, first, rows_first, rows_second)
    alone_second = _lone(right, second, rows_second, rows_first)
    rival_first, rival_second = _brightest(left, alone_first), _brightest(right, alone_second)
    _believe(left, alone_first, rival_second, run_rows, first)
    _believe(right, alone_second, rival_first, run_rows, second)
    return first, second


@njit(cache=True, nogil=True)
def pairs(left: Verdicts, right: Verdicts, partner: Indices) -> tuple[Indices, Indices]:
    """Left and right candidates (n,), (n,) that are believed and belong together; one a row."""
    index, other = np.empty(len(left), np.int64), np.empty(len(left), np.int64)
    n = 0
    for i in range(len(left)):
        if left[i] == _BOTH and partner[i] >= 0 and right[partner[i]] == _BOTH:
            index[n], other[n] = i, partner[i]
            n += 1
    return index[:n], other[:n]


@njit(cache=True, nogil=True)
def unexplained_px2(side: Candidates, verdict: Verdicts) -> float:
    """Variance of the stripe's columns that their stated sigmas leave unexplained: speckle, mostly.

    The columns' second differences over `LAG_ROWS`, so that rows of one grain do not count as smooth.
    """
    rows = len(side.start) - 1
    column, stated = np.full(rows, np.nan), np.full(rows, np.nan)
    for n in range(len(verdict)):
        if verdict[n] == _BOTH:
            column[side.row[n]], stated[side.row[n]] = side.measured[0, n], side.measured[1, n]
    bend, usual = np.empty(rows), np.empty(rows)
    n = 0
    for r in range(LAG_ROWS, rows - LAG_ROWS, 2):
        value = column[r + LAG_ROWS] - 2.0 * column[r] + column[r - LAG_ROWS]
        if not np.isnan(value):
            bend[n], usual[n] = abs(value), stated[r]
            n += 1
    if n < FEW:
        return 0.0
    seen, known = 1.4826 * median(bend, n) / np.sqrt(6.0), median(usual, n)
    return max(seen * seen - known * known, 0.0)


@njit(cache=True, nogil=True)
def count(verdict: Verdicts) -> Indices:
    """How many candidates met each `Verdict`, (9,)."""
    out = np.zeros(VERDICTS, np.int64)
    for n in range(len(verdict)):
        out[verdict[n]] += 1
    return out
