"""Which samples of a log are no measurements of a surface, and why: the rules, for whole logs and for live streams.

A row of telemetry is a time, a position and the command in force then. Rules that look at one surface take its rows
(`Rows`); a bus that stands still shows in the rows of all surfaces together (`standing`). Each rule looks no further
ahead than `WAIT_S`, so that a monitor marks the same samples as an audit once it has waited for so long; but for a bus
that shows only later that it stands: what came before is judged in flight, and left out of an audit.
"""

from __future__ import annotations

from bisect import bisect_right
from enum import IntEnum
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servofd.core.types import BoolArray, FloatArray, IntArray, Marks
from servofd.servo.loops import compiled, inner


class Why(IntEnum):
    """Why a sample does not count; the first three leave its value, the others are no measurement."""

    COUNTS = 0
    GAP = 1
    """No command is known, or the last one is older than a second."""
    UNSETTLED = 2
    """Within a second of an unknown beginning: what moved the servo before is not known."""
    MISSING = 3
    """The log holds no value."""
    DUPLICATE = 4
    """A row written again before the servo answered anew, within 0.1 s."""
    HELD = 5
    """A logger or a late bus that repeats the last value for up to 0.25 s, or four rows, while the servo moves."""
    FROZEN = 6
    """All servos that report repeat their readings at once while some are asked to move."""
    ECHO = 7
    """The command, written where the position belongs."""
    SPIKE = 8
    """A reading that jumps away and back within 60 ms, as no command asked."""
    BOOT = 9
    """Of another boot of the vehicle than the longest in the log."""
    TORQUE_OFF = 10
    """The log says that the servo was not powered."""


NO_OTHERS: Final = -1
"""In place of whether other values of a telemetry changed: there are none."""
OWN_TELEMETRY: Final = 2
"""What `standing` says of a row if this servo's telemetry alone stands still."""
LAST_WITH_VALUE: Final = Why.UNSETTLED
"""Samples marked so, or less, keep their value."""

WAIT_S: Final = 0.25
"""Longest time for which a row is undecided [s]: a late bus is back by then (answers of an ArduPlane's six Volz servos
came up to 0.2 s late, software in the loop)."""
_ROWS_WAITED, _SLOW_WAIT_S = 4, 0.5
"""The same where rows come so seldom that it is fewer than so many: at 10 Hz 0.4 s."""
DUPLICATE_S: Final = 0.1
"""Readings of that bus are refreshed every 45 ms, at times after 80 ms; rows that repeat for less are no news."""
FROZEN_S: Final = 0.1
"""All servos must stand still for so long [s]: longer than one of them takes to answer."""
ASKED_DEG: Final = 0.5
"""Readings of a servo that is asked to move so far change: no known telemetry is coarser but by its own steps."""
_STEPS: Final = 2.5
"""More than two steps of a reading at once are motion: noise moves a quantised reading by one, rarely by two."""
_LATELY_S: Final = 0.1
"""The command of so long ago is what a servo follows now: hobby servos have lags of 30 to 160 ms."""
_DELAY_S: Final = 0.06
"""A servo may take so long to begin to move: what it was asked later its reading does not owe yet. 50 ms marked
12 rows of a software-in-the-loop flight with positions every 50 ms as frozen and 18 as held, 60 ms one and two."""
_UNDER_WAY_S: Final = 1.0
"""For so long after its last change a servo that was under way is expected to go on: the slowest of the library
crosses its travel within it."""
_SILENT_S: Final = 1.0
"""A servo that has sent no row for so long does not report."""
_LATE_AFTER_S: Final = 0.15
"""A bus that stood brings commands late as well: for so long after it the servos catch up (80 ms late after a freeze of
0.2 s, an ArduPlane's six Volz servos, software in the loop)."""
_FEWEST_RESTS: Final = 50
"""Rows at rest that tell for how long a reading usually stays the same: a second at 50 Hz."""
_ASKED_TELLS, _MOST_EVIDENCE, _ENOUGH_EVIDENCE = 6.0, 8.0, 10.0
"""Minus the logarithm of the chance that readings stay the same while telemetry lives: that of a servo that is asked to
move (it may be jammed), the most that one servo adds, and what all together need: 5e-5, and no servo alone."""
_FEWEST_ROWS: Final = 200
"""Rows that tell for how long voltage and current of a servo may stay the same: four seconds at 50 Hz."""
_OWED_BESIDE, _FEWEST_REPEATS = 10.0, 3.0
"""Times the longest that they stayed the same before (the current of a Volz that jams rests with it), and rows if they
never did."""
_DEAD_S: Final = 0.5
"""A servo whose position, voltage and current all repeat for so long while it is asked to move has no telemetry."""
TINY_DEG: Final = 1e-6
"""Smaller differences are rounding of text and of single precision."""
_MEMORY: Final = 18
"""Numbers that `standing` remembers of a servo; their places follow, the last of the bus, with the first servo."""
_NEWEST, _CHANGED, _REPEATS, _THEN, _BEFORE, _LAG, _ASKED, _STEP, _STIRRED = range(9)
_RESTS, _RUNS, _SQUARES, _SAME, _SAME_ROWS, _SAME_LONGEST, _STOOD, _OWING, _LAST_STOOD = range(9, _MEMORY)


def new_bus(servos: int) -> FloatArray:
    """Memory of `standing` for so many servos, before any row."""
    memory = np.zeros((servos, _MEMORY))
    memory[:, [_NEWEST, _CHANGED, _STIRRED, _LAST_STOOD]] = -np.inf
    memory[:, [_THEN, _BEFORE, _LAG, _ASKED]] = np.nan
    memory[:, [_STEP, _OWING]] = np.inf
    return memory


def last_change_s(memory: FloatArray) -> float:
    """When any reading of a bus changed last [s]."""
    return float(memory[:, _CHANGED].max())


@inner
def _take(m: FloatArray, time_s: float, moved_deg: float, asked_deg: float, other: int) -> None:
    """Take a row of one servo into its memory."""
    if np.isnan(m[_LAG]):
        m[_LAG] = m[_ASKED] = asked_deg
    else:
        m[_LAG] += (1.0 - np.exp(-max(time_s - m[_NEWEST], 0.0) / _LATELY_S)) * (m[_ASKED] - m[_LAG])
    if asked_deg != m[_ASKED]:
        m[_STIRRED] = time_s
    m[_ASKED], m[_NEWEST] = asked_deg, time_s
    rests = abs(m[_ASKED] - m[_LAG]) <= ASKED_DEG
    m[_RESTS] += rests
    m[_SAME_ROWS] += other >= 0
    m[_SAME] += other == 0
    if other == 1:
        if not m[_STOOD]:
            m[_SAME_LONGEST] = max(m[_SAME_LONGEST], m[_SAME])
        m[_SAME] = 0.0
    if moved_deg != 0.0 or other == 1:
        if rests and not m[_STOOD]:
            m[_RUNS] += m[_REPEATS]
            m[_SQUARES] += m[_REPEATS] ** 2
        m[_STOOD], m[_OWING] = 0.0, np.inf
        m[_CHANGED], m[_REPEATS], m[_THEN], m[_BEFORE] = time_s, 0.0, asked_deg, m[_LAG]
        if moved_deg > TINY_DEG:
            m[_STEP] = min(m[_STEP], moved_deg)
    else:
        m[_REPEATS] += 1.0
    least_deg = ASKED_DEG if np.isinf(m[_STEP]) else max(ASKED_DEG, _STEPS * m[_STEP])
    under_way = time_s - m[_CHANGED] <= _UNDER_WAY_S and abs(m[_ASKED] - m[_BEFORE]) > least_deg
    if under_way or abs(m[_ASKED] - m[_THEN]) > least_deg:
        m[_OWING] = min(m[_OWING], time_s)


@inner
def _is_asked(m: FloatArray, time_s: float) -> bool:
    """Whether a servo was asked to move since its reading changed last, with time to do so, or was under way then."""
    return bool(time_s - m[_OWING] >= _DELAY_S - TINY_DEG)


@inner
def _flickers(m: FloatArray) -> float:
    """How many usual runs of equal readings at rest the present one is long; 0 while that is not known.

    Long runs count more in the mean, so that a reading which rests now and then is never taken for one in motion.
    """
    if m[_RESTS] < _FEWEST_RESTS:
        return 0.0
    return float(m[_REPEATS] / (max(m[_SQUARES] / m[_RUNS], 1.0) if m[_RUNS] > 0.0 else 1.0))


@inner
def _all_stand(memory: FloatArray, time_s: float) -> tuple[bool, bool]:
    """Whether all servos that report have repeated for so long that none alone can be the reason; are commands given.

    One that has sent nothing since the others changed last says nothing. Readings that flicker, and stop to do so
    while commands go on, tell it of servos at rest.
    """
    latest_s = -np.inf
    for j in range(memory.shape[0]):
        if memory[j, _REPEATS] >= 2.0 and time_s - memory[j, _NEWEST] <= _SILENT_S:
            latest_s = max(latest_s, memory[j, _CHANGED])
    reporting, stirred, evidence = 0, False, 0.0
    for j in range(memory.shape[0]):
        m = memory[j]
        if time_s - m[_NEWEST] > _SILENT_S:
            continue
        if m[_REPEATS] < 2.0:
            if m[_NEWEST] > latest_s:
                return False, False
            continue
        reporting += 1
        # What it was asked, and did not do, while another reading still changed tells nothing of a bus.
        stirred = stirred or m[_STIRRED] > latest_s or latest_s <= m[_OWING] < np.inf
        is_asked = m[_OWING] > latest_s - DUPLICATE_S and _is_asked(m, time_s)
        evidence += _ASKED_TELLS if is_asked else min(_flickers(m), _MOST_EVIDENCE)
    return reporting >= 2 and evidence >= _ENOUGH_EVIDENCE and time_s - latest_s >= FROZEN_S - TINY_DEG, stirred


@compiled
def standing(
    memory: FloatArray, who: IntArray, time_s: FloatArray, moved_deg: FloatArray, asked_deg: FloatArray, other: Marks,
    stands: Marks,
) -> None:  # fmt: skip
    """Tell of each row whether the bus stands still then, 1, or this servo's telemetry alone, 2; else 0.

    The rows are those of all servos in order of time, shape (n,): whose it is, by how much its reading differs from
    the one before [deg], the command in force [deg], and whether other values of its telemetry (voltage, current)
    changed: 1, 0, or -1 where there are none. `memory` is from `new_bus` and moves on; `stands` is filled.
    """
    for k in range(time_s.size):
        m = memory[who[k]]
        _take(m, time_s[k], moved_deg[k], asked_deg[k], other[k])
        stands[k] = time_s[k] - memory[0, _LAST_STOOD] <= _LATE_AFTER_S
        if m[_REPEATS] < 2.0:
            continue
        if (
            time_s[k] - m[_CHANGED] >= _DEAD_S
            and m[_SAME_ROWS] >= _FEWEST_ROWS
            and m[_REPEATS] >= max(_FEWEST_REPEATS, _OWED_BESIDE * m[_SAME_LONGEST])
            and _is_asked(m, time_s[k])
        ):
            stands[k], m[_STOOD] = OWN_TELEMETRY, 1.0
            continue
        all_stand, stirred = _all_stand(memory, time_s[k])
        if all_stand:
            stands[k], m[_STOOD] = stirred, 1.0
            if stirred:
                memory[0, _LAST_STOOD] = time_s[k]


class Rows(NamedTuple):
    """Rows of one surface that hold a value, in order of time, shape (n,)."""

    time_s: FloatArray
    position_deg: FloatArray
    asked_deg: FloatArray
    """The command in force, in the same degrees as the position, without corrections that were fitted."""
    other: Marks
    """As `standing` takes it."""
    stands: Marks
    """What `standing` says."""
    step_deg: float = np.inf
    """Smallest change of the reading before these rows [deg]."""
    refresh_s: float = 0.0
    """How often the reading is refreshed, if rows are written more often [s]; see `refresh_of`."""
    decided: int = 0
    """How many of the rows were decided before: they only tell of those that follow."""


def moved(position_deg: FloatArray) -> FloatArray:
    """By how much each reading differs from the one before [deg], the first by infinity."""
    moved_deg = np.full(position_deg.size, np.inf)
    moved_deg[1:] = np.abs(position_deg[1:] - position_deg[:-1])
    return moved_deg


def marked(rows: Rows, *, final: bool = True) -> tuple[Marks, int]:
    """Why each row does not count, shape (n,), and how many of them are decided; all of them if nothing more comes."""
    why = np.zeros(rows.time_s.size, dtype=np.int8)
    if why.size < 2:
        return why, why.size if final else 0
    undecided = [_spikes(rows, why), _repeats(rows, why), _echoes(rows, why)]
    return why, why.size if final else min(undecided)


def is_young(age_s: ArrayLike, repeats: ArrayLike) -> BoolArray:
    """Whether values that repeat for so long [s], in so many rows, may be a late bus's or a logger's."""
    age_s, repeats = np.asarray(age_s), np.asarray(repeats)
    return (age_s < WAIT_S - TINY_DEG) | ((repeats <= _ROWS_WAITED) & (age_s < _SLOW_WAIT_S - TINY_DEG))


def _repeats(rows: Rows, why: Marks) -> int:
    """Mark what only repeats; the first row that is not decided yet."""
    time_s, size = rows.time_s, rows.time_s.size
    moved_deg = moved(rows.position_deg)
    same = (moved_deg == 0.0) & (rows.other <= 0)
    why[~same & (rows.stands > 0)] = Why.FROZEN  # of a bus that stood until then
    if not same[max(rows.decided - 1, 0) :].any():  # a run that is over tells of nothing that follows it
        return size
    firsts = np.flatnonzero(~same)
    run = np.cumsum(~same) - 1
    lasts = np.append(firsts[1:], size) - 1
    age_s = time_s - time_s[firsts[run]]
    early = is_young(age_s, np.arange(size) - firsts[run])
    left_deg = np.append(moved_deg[firsts[1:]], np.nan)  # by how much the reading moves in the end
    steps = np.where((moved_deg > TINY_DEG) & np.isfinite(moved_deg), moved_deg, np.inf)
    least_deg = _STEPS * np.minimum(np.minimum.accumulate(steps)[lasts], rows.step_deg)
    over = np.arange(lasts.size) < lasts.size - 1
    clear = over & (left_deg > least_deg) & (lasts > firsts) & early[lasts]
    waits = bool(clear.size > 1 and clear[-2] and firsts[-1] == size - 1)  # for the row after the jump
    entered_deg = np.where(np.isfinite(moved_deg[firsts]), moved_deg[firsts], 0.0)
    steps_apart = _STEPS * np.minimum(np.nan_to_num(left_deg), entered_deg) / least_deg
    chance = (lasts - firsts) * np.log1p(steps_apart)
    sure = clear & (chance >= _NO_CHANCE)  # whatever was asked meanwhile
    sure[sure] = _is_inside(rows.position_deg[firsts], np.flatnonzero(sure), least_deg[sure])
    clear[clear] = _is_clear(rows, firsts, lasts, np.flatnonzero(clear)) | sure[clear]
    span_s = age_s[lasts]
    before = np.searchsorted(time_s, time_s[firsts] - _ANSWER_S)
    answered = np.maximum(np.searchsorted(time_s, time_s[lasts] - _DELAY_S, side="right") - 1, firsts)
    asked_deg = rows.asked_deg[np.stack([before, firsts, answered])]  # a servo may still follow what came before
    asked = np.ptp(asked_deg, axis=0) >= ASKED_DEG
    silent = over & (rows.other[lasts] == 0)
    short = span_s < DUPLICATE_S - TINY_DEG
    late = sure | (clear & (short | (asked & (left_deg >= ASKED_DEG))))
    held = np.append(0, np.cumsum(late))
    lately = held[:-1] - held[np.searchsorted(time_s[lasts], time_s[firsts] - _HOLDS_S)]
    ways = np.sign(np.diff(rows.position_deg[firsts], prepend=np.nan, append=np.nan))
    goes_on = over & early[lasts] & (ways[1:] == ways[:-1])
    late |= goes_on & (chance >= _AFTER_HOLDS[np.minimum(lately, _AFTER_HOLDS.size - 1)])
    again, late = (late | silent) & short, late & ~short
    why[same & again[run]] = Why.DUPLICATE
    why[same & late[run]] = Why.HELD
    if rows.refresh_s > 0.0:
        due = np.floor((age_s + 0.5 * np.diff(time_s, prepend=time_s[0])) / rows.refresh_s)  # in the row next to it
        why[same & (np.diff(due, prepend=0.0) <= 0.0)] = Why.DUPLICATE
    # What waits is decided with the first row that is old enough; the rows after that each by itself.
    until = np.minimum(firsts + np.add.reduceat(early, firsts), lasts)
    stands = rows.stands > 0
    stood = np.concatenate([[0], np.cumsum(stands)])
    at_first = stood[until + 1] > stood[firsts + 1]
    why[same & np.where(early, at_first[run], stands)] = Why.FROZEN
    # Where voltage and current stand still as well, the telemetry was dead from the first of them on.
    dead = np.maximum.reduceat(rows.stands, firsts) == OWN_TELEMETRY
    why[same & dead[run]] = Why.FROZEN
    if waits:
        return int(firsts[-2]) + 1
    return int(firsts[-1]) + 1 if early[-1] else size


def _is_clear(rows: Rows, firsts: IntArray, lasts: IntArray, which: IntArray) -> BoolArray:
    """Whether readings that repeat and then jump were old, shape (k,), of some of the runs of equal readings.

    The motion is much smoother without the repeats, or the jump stands out of the noise and it is smoother. A servo at
    its stop, or one that sticks, sets out from rest: its jump is no larger than the motion that follows.
    """
    if not which.size:
        return np.zeros(0, dtype=bool)
    deg = rows.position_deg
    begin, last, out = firsts[which], lasts[which], lasts[which] + 1
    fresh = firsts[np.maximum(which - 1, 0)]
    rougher = _unsteadiness(rows, fresh, begin, last, out, out + 1) / _unsteadiness(rows, fresh, begin, out, out + 1)
    stands_out = np.abs(deg[out] - deg[last]) > _CLEAR * _bend_deg(deg[firsts], which)
    return (rougher >= _MUCH_ROUGHER) | (stands_out & (rougher >= _ROUGHER))


def _unsteadiness(rows: Rows, *path: IntArray | int) -> FloatArray:
    """By how much the speed changes along some rows, each of shape (k,), altogether [deg/s], shape (k,)."""
    rows_of = np.minimum(np.stack(np.broadcast_arrays(*path)), rows.time_s.size - 1)
    step_s = np.maximum(np.diff(rows.time_s[rows_of], axis=0), _STEP_S)
    changes = np.abs(np.diff(np.diff(rows.position_deg[rows_of], axis=0) / step_s, axis=0))
    return np.asarray(np.maximum(changes.sum(axis=0), TINY_DEG))


def _bend_deg(fresh_deg: FloatArray, where: IntArray) -> FloatArray:
    """Second difference of the fresh readings before some of them, where they move most steadily: noise."""
    unknown = np.full(_BEFORE_ROWS + 2, np.inf)  # nothing jumps out of the noise before that is known
    bends = np.concatenate([unknown, np.abs(np.diff(fresh_deg, 2))])
    windows = np.lib.stride_tricks.sliding_window_view(bends, _BEFORE_ROWS)[where]
    return np.asarray(np.percentile(windows, _STEADIEST, axis=1, method="higher"))


def _is_inside(fresh_deg: FloatArray, which: IntArray, least_deg: FloatArray) -> BoolArray:
    """Whether some readings are neither the largest nor the smallest of those before: a servo rests at its stops."""
    before_deg = np.concatenate([np.full(_BEFORE_ROWS, np.nan), fresh_deg])
    windows = np.lib.stride_tricks.sliding_window_view(before_deg, _BEFORE_ROWS)[which]
    high_deg, low_deg = np.nanmax(windows, axis=1, initial=-np.inf), np.nanmin(windows, axis=1, initial=np.inf)
    return np.asarray(np.minimum(high_deg - fresh_deg[which], fresh_deg[which] - low_deg) > least_deg)


_ROUGHER, _MUCH_ROUGHER, _STEP_S = 1.5, 4.0, 1e-4
"""How many times as much the speed changes with the repeats as without them: of a servo that sets out from rest not at
all, of one in steady motion at least four times as much. No two rows are closer than the last [s]."""
_NO_CHANCE: Final = 4.0
"""Minus the logarithm of the chance that readings repeat bit for bit amid motion by many of their steps: 2 %."""
_AFTER_HOLDS: Final = np.array([np.inf, 5.0, 1.4])
"""The same where the motion goes on as it came, for none, one and more values that were surely held just before: also
of an extreme, at which a servo may rest. On four aircraft of even seed and their holds (`benchmarks/telemetry.py`) 75
of 841 held rows that are wrong by 1 deg are not marked, and of sound rows .12 % are (.07 % without the one of 5)."""
_HOLDS_S: Final = 1.5
"""For so long [s] a telemetry is known to hold values."""
_STEADIEST, _CLEAR = 25.0, 8.0
"""Percentile of those second differences, and how many times as far a reading jumps that was old: by six standard
deviations of white noise."""
_SPIKE_S: Final = 0.06
"""A surface that is thrown so far and back for less was never there: servos of 60 deg in 0.1 s take as long to turn."""
_LEAST_SPIKE_DEG: Final = 0.5
"""Smaller ones move no residual beyond a threshold that noise leaves free."""
_OF_NOISE, _OUT_OF_NOISE = 3.0, 8.0
"""Times the median second difference of the readings before: no spike below 5 standard deviations of white noise, and
above 13 surely one; between them it is one where the motion without it were much smoother."""
_BACK, _BEYOND, _ASKED_FOR = 1.0 / 3.0, 2.0, 0.5
"""Share of a spike within which the reading is back, and beyond which motion to the other side has not taken it; share
of it that a command asked for within as long, or by which it sets out and comes back faster than the motion around."""
_BEFORE_ROWS, _FEWEST_BEFORE, _ASKED_BEFORE_S = 32, 4, 0.5
"""Rows that tell the noise, at most and at least, and how long before its motion a servo may have been asked for it."""


def _spikes(rows: Rows, why: Marks) -> int:
    """Mark readings that jump away and back; the first row that is not decided yet."""
    time_s, position_deg = rows.time_s, rows.position_deg
    jump_deg = np.abs(np.diff(position_deg))
    step_deg = np.minimum.accumulate(np.append(rows.step_deg, np.where(jump_deg > TINY_DEG, jump_deg, np.inf)))
    least_deg = np.maximum(_LEAST_SPIKE_DEG, np.where(np.isinf(step_deg[:-1]), 0.0, _STEPS * step_deg[:-1]))
    undecided, taken = time_s.size, _FEWEST_BEFORE
    if rows.decided:
        taken = max(taken, int(np.searchsorted(time_s, time_s[rows.decided - 1] - _SPIKE_S - TINY_DEG)))
    first = max(taken - 1, 0)
    times, deg, last = time_s.tolist(), position_deg.tolist(), time_s.size - 1
    away = jump_deg > least_deg
    away[:first] = False
    for k in _thrown_back(time_s, position_deg, away, _SPIKE_S + TINY_DEG):
        if k < taken:
            continue
        until = max(bisect_right(times, times[k] + _SPIKE_S + TINY_DEG) - 1, k + 1)
        before_deg, size_deg = deg[k - 1], abs(deg[k] - deg[k - 1])
        side = 1.0 if deg[k] > before_deg else -1.0
        near = (j for j in range(k + 1, min(until, last) + 1))
        back = next((j for j in near if -_BEYOND <= (deg[j] - before_deg) * side / size_deg <= _BACK), last + 1)
        is_open = back > last
        if (is_open and until <= last) or not (is_open or _is_thrown(times, deg, k, back)):
            continue
        back = min(back, last)
        bend_deg = float(np.median(np.abs(np.diff(position_deg[max(k - _BEFORE_ROWS, 0) : k], 2))))
        if size_deg <= _OF_NOISE * bend_deg or _was_asked(rows, k, back, size_deg):
            continue
        if size_deg <= _OUT_OF_NOISE * bend_deg:
            is_open = is_open or back == last  # the row after it tells
            around = _unsteadiness(rows, k - 2, k - 1, back, back + 1)
            if not is_open and _unsteadiness(rows, *range(k - 2, back + 2)) < _MUCH_ROUGHER * around:
                continue
        if is_open:
            undecided = k
            break
        why[k:back] = Why.SPIKE
        taken = back + 1
    return undecided


def _thrown_back(time_s: FloatArray, values_deg: FloatArray, away: BoolArray, within_s: float) -> list[int]:
    """Rows that jump away, of those marked (n - 1,), and are back, or may still be back, within a time [s]."""
    rows = 1 + np.flatnonzero(away)
    until = np.searchsorted(time_s, time_s[rows] + within_s, side="right")
    jump_deg = values_deg[rows] - values_deg[rows - 1]
    back = until >= time_s.size  # what follows is not known
    for later in range(1, int((until - rows).max(initial=0)) + 1):
        there = np.minimum(rows + later, time_s.size - 1)
        back |= (later <= np.maximum(until - rows - 1, 1)) & (
            (values_deg[there] - values_deg[rows - 1]) / jump_deg <= _BACK
        )
    found: list[int] = rows[back].tolist()
    return found


def _is_thrown(times: list[float], deg: list[float], first: int, back: int) -> bool:
    """Whether an excursion sets out and comes back faster than the motion around it: an overshoot slows down first."""
    apart_deg = []
    for inside, edge, beside in ((first, first - 1, max(first - 2, 0)), (back - 1, back, min(back + 1, len(deg) - 1))):
        step_s, before_s = abs(times[inside] - times[edge]), abs(times[edge] - times[beside])
        going_deg = (deg[edge] - deg[beside]) * min(step_s / max(before_s, _STEP_S), _BEYOND)
        apart_deg.append(deg[inside] - deg[edge] - going_deg)
    size_deg = deg[first] - deg[first - 1]
    thrown_deg = min(apart_deg) if size_deg > 0.0 else -max(apart_deg)
    return thrown_deg >= _ASKED_FOR * abs(size_deg)


def _was_asked(rows: Rows, first: int, back: int, size_deg: float) -> bool:
    """Whether a command of the last half second asked for the like of an excursion: to go out, and back as soon."""
    begin = int(np.searchsorted(rows.time_s, rows.time_s[first] - _ASKED_BEFORE_S))
    side = np.sign(rows.position_deg[first] - rows.position_deg[first - 1])
    asked_deg, rest = side * rows.asked_deg[begin : back + 1], np.full(back - first + 1, np.inf)
    # By how much the command went out and came back (or may yet), within as many rows to either side.
    before_deg, after_deg = np.concatenate([rest, asked_deg]), np.concatenate([asked_deg, -rest])
    windows = np.lib.stride_tricks.sliding_window_view
    from_deg, to_deg = windows(before_deg, rest.size)[:-1].min(axis=1), windows(after_deg, rest.size)[1:].min(axis=1)
    away_deg = asked_deg - np.maximum(from_deg, to_deg)
    return bool(away_deg[np.isfinite(away_deg)].max(initial=0.0) >= _ASKED_FOR * size_deg)


def _swing_deg(values_deg: FloatArray, width: int) -> float:
    """By how much values differ at most that are so many samples apart, or fewer."""
    apart = range(1, min(width, values_deg.size - 1) + 1)
    return max((float(np.abs(values_deg[k:] - values_deg[:-k]).max()) for k in apart), default=0.0)


_ECHOES: Final = 3
"""New commands in a row that a position equals at once; a servo that comes close to one by chance misses the next."""


def _echoes(rows: Rows, why: Marks) -> int:
    """Mark positions that equal a moving command, or jump onto one at rest; the first row that is not decided yet."""
    asked_deg = rows.asked_deg
    equal = np.abs(rows.position_deg - asked_deg) <= TINY_DEG * np.maximum(1.0, np.abs(asked_deg))
    if not equal[rows.decided :].any():
        return equal.size
    new = equal & (np.abs(np.diff(asked_deg, prepend=asked_deg[0])) > TINY_DEG)
    onto = equal & _is_unasked(rows)
    if not (new | onto).any():
        return equal.size
    run = np.cumsum(~equal)  # rows of one stretch of equality have the same number
    rows_of = int(run[-1]) + 1
    echoed = np.bincount(run[new], minlength=rows_of) >= _ECHOES
    echoed |= (np.bincount(run[onto], minlength=rows_of) > 0) & (np.bincount(run[equal], minlength=rows_of) >= _ECHOES)
    since = np.full(rows_of, equal.size)
    np.minimum.at(since, run[new | onto], np.flatnonzero(new | onto))
    why[equal & echoed[run] & (np.arange(equal.size) >= since[run])] = Why.ECHO
    return int(since[run[-1]]) if equal[-1] and not echoed[run[-1]] else equal.size


def _is_unasked(rows: Rows) -> BoolArray:
    """Readings that jump out of a rest, though no command of the last half second asked for it, or as no servo can."""
    moved_deg = np.where(np.isfinite(rows.position_deg), moved(rows.position_deg), 0.0)
    unasked = np.zeros(moved_deg.size, dtype=bool)
    begun = np.searchsorted(rows.time_s, rows.time_s - _ASKED_BEFORE_S)
    onset = (moved_deg > ASKED_DEG) & np.isfinite(moved_deg)
    onset[1:] &= (moved_deg[1:] > _STEPS * moved_deg[:-1]) | (begun[1:] == np.arange(1, begun.size))
    for k in np.flatnonzero(onset).tolist():
        begin = int(begun[k])
        lately_deg = max(float(moved_deg[begin:k].max(initial=0.0)), ASKED_DEG / _STEPS)
        rested = begin > 0 and moved_deg[k] > _STEPS * lately_deg
        at_once = 4.0 * moved_deg[k] > _SHARPEST_DEG_S2 * (rows.time_s[k] - rows.time_s[k - 1]) ** 2
        unasked[k] = rested and (at_once or np.ptp(rows.asked_deg[begin : k + 1]) < _ASKED_FOR * moved_deg[k])
    return unasked


_SHARPEST_DEG_S2: Final = 1e5
"""No servo speeds up, and then stops, so sharply: the fastest of the hobby (0.04 s for 60 deg) in 15 ms."""
_LEAST_COMMAND_SPIKE_DEG: Final = 2.0
"""Smaller ones move no servo by more than the smallest fault that is reported."""
_COMMAND_SPIKE_S: Final = 0.0625
"""A command that was in force for at most three rows of 50 Hz, with 2.5 ms for their jitter."""
_ANSWER_S, _ANSWER = 0.3, 0.1
"""A servo that gets a command answers within this time [s] by this share: one of 60 deg/s moves by a quarter of 15 deg
in 60 ms, and the slowest lag of the library is 0.16 s."""


def unanswered(command_s: FloatArray, command_deg: FloatArray, rows: Rows) -> BoolArray:
    """Commands that jump away and back within 60 ms, once, while the position does not answer, shape (m,).

    Examples
    --------
    >>> time_s = np.arange(0.0, 2.0, 0.02)
    >>> asked_deg = np.where((time_s > 0.99) & (time_s < 1.03), 25.0, 5.0)
    >>> none, never = np.full(100, -1, dtype=np.int8), np.zeros(100, dtype=np.int8)
    >>> np.flatnonzero(unanswered(time_s, asked_deg, Rows(time_s, np.full(100, 5.0), asked_deg, none, never)))
    array([50, 51])
    """
    found = np.zeros(command_s.size, dtype=bool)
    if command_s.size < 3 or rows.time_s.size < 2:
        return found
    jump_deg = np.diff(command_deg)
    away = np.abs(jump_deg) > _LEAST_COMMAND_SPIKE_DEG
    for k in _thrown_back(command_s, command_deg, away, _COMMAND_SPIKE_S):
        until = int(np.searchsorted(command_s, command_s[k] + _COMMAND_SPIKE_S, side="right"))
        side = np.sign(jump_deg[k - 1])
        away_deg = (command_deg[k:until] - command_deg[k - 1]) * side
        near = np.flatnonzero(np.abs(away_deg[1:]) <= _BACK * away_deg[0])
        if found[k - 1] or not near.size:
            continue
        back = k + 1 + int(near[0])
        begin, end = np.searchsorted(command_s, (command_s[k] - _ASKED_BEFORE_S, command_s[k] + _ASKED_BEFORE_S))
        around_deg = np.append(command_deg[begin:k], command_deg[back:end])
        first, last = np.searchsorted(rows.time_s, (command_s[k], command_s[k] + _ANSWER_S)).tolist()
        seen_deg = rows.position_deg[max(first - 1, 0) : last]
        answer_deg = float(((seen_deg - seen_deg[0]) * side).max()) if last - first >= 2 else np.inf
        if answer_deg < _ANSWER * away_deg[0] and _swing_deg(around_deg, back - k + 1) < _ASKED_FOR * away_deg[0]:
            found[k:back] = True
    return found


def is_mostly_echo(rows: Rows, why: Marks) -> bool:
    """Whether a position is the command wherever that moves, and so no measurement at all."""
    new = np.abs(np.diff(rows.asked_deg, prepend=rows.asked_deg[:1])) > TINY_DEG
    return bool(new.any() and np.all(why[new] == Why.ECHO))


_HELD_STEPS, _SMALLEST = 3.0, 0.02
"""A jump of so many steps of the readings is motion or noise, which goes on; that quantile of all jumps is a step."""
_FEWEST_JUMPS, _ROWS_HELD = 30, 1.5
"""Jumps that tell, and rows from one to the next beyond which readings are held."""
_REGULAR, _ON_TIME = 0.6, 1.0 / 3.0
"""Share of the jumps that follow the one before at the usual time, or a multiple, to within a third of it."""


def refresh_of(time_s: FloatArray, position_deg: FloatArray) -> float:
    """How often a reading is refreshed that comes steadily and more seldom than rows are written [s]; 0 if it does not.

    Examples
    --------
    >>> time_s = np.arange(0.0, 10.0, 0.01)
    >>> position_deg = np.sin(3.0 * time_s)
    >>> refresh_of(time_s, position_deg), round(refresh_of(time_s, position_deg[5 * (np.arange(1000) // 5)]), 3)
    (0.0, 0.05)
    """
    jumps_deg = moved(position_deg)
    jumped = np.flatnonzero((jumps_deg > 0.0) & np.isfinite(jumps_deg))
    if jumped.size < _FEWEST_JUMPS:
        return 0.0
    clear = jumps_deg[jumped] > _HELD_STEPS * float(np.quantile(jumps_deg[jumped], _SMALLEST))
    apart = np.diff(jumped)[clear[1:] & clear[:-1]]
    if apart.size < _FEWEST_JUMPS or np.median(apart) <= _ROWS_HELD:
        return 0.0
    ratio = apart / np.median(apart)
    if np.mean(np.abs(ratio - np.maximum(np.round(ratio), 1.0)) < _ON_TIME) < _REGULAR:
        return 0.0
    return float(np.median(apart) * np.median(np.diff(time_s)))
