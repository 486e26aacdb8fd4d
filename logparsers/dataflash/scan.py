"""Walk the chain of records of a binary log: where each begins, which bytes are damaged, where time jumps.

A record is ``A3 95 type payload`` with the length its type was given; there is no checksum. The only
evidence is the chain: behind a sound record the next one begins. Where the chain breaks, a record that hides
the beginning of another, sound one is itself damage (cut short, or a header that never was one).

`stride` follows a sound chain by whole arrays, thirty times as fast as `walk` does record by record. Where it stops,
`walk` goes on.
"""

from __future__ import annotations

import re
from array import array
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Ints = array[int] | NDArray[Any]

A_FEW: Final = 64
"""Records that are walked one by one before the rest is tried as a whole again."""
STRIDE: Final = (1 << 12, 1 << 19)
"""Bytes of a stride, at first and at most: each eight times as long as the one before, as long as nothing stops it."""
FMT_TYPE, FMT_SIZE = 128, 89
"""Of a definition of messages: its type, and its bytes."""

# state
AT, DONE_FMT, CLOCK, PENDING, SETTLED, WAITING_US, WAITING_AT = 0, 1, 2, 3, 4, 5, 9
"""Places of the walk's state. SETTLED: no more definitions come. From WAITING_AT on: where the waiting records
are."""
CONFIRM: Final = 4
"""Records that must agree before a jump of the clock is believed."""
STATE_SIZE: Final = WAITING_AT + CONFIRM

# why walk() returned
FULL, NEW_FORMAT, END = 0, 1, 2

# kinds of damaged stretches
BAD_HEADER, BAD_CUT, BAD_TAIL = 0, 1, 2

GAP_US: Final = 1_000_000
"""Silence of all messages that is worth a line in the report [us]."""
BACK_US: Final = 2_000_000
"""How far a stamp may go back [us]: some messages carry the time of their measurement, not of their writing."""
AHEAD_US: Final = 86_400_000_000
"""How far a stamp may jump ahead [us], a day."""
NO_TIME: Final = -1

BATCH: Final = 1 << 18
"""Records of a batch."""
EVENTS: Final = 1 << 12
"""Damaged stretches, and jumps of the clock, that a call can hold."""


def is_header(data: memoryview, at: int, size: int, length: Ints) -> bool:
    """Tell whether a known message type begins here."""
    return at + 3 <= size and data[at] == 0xA3 and data[at + 1] == 0x95 and length[data[at + 2]] > 0


def is_chained(data: memoryview, at: int, size: int, length: Ints) -> bool:
    """Tell whether a known message type begins here, and another where it ends."""
    if not is_header(data, at, size, length):
        return False
    end = at + length[data[at + 2]]
    return end == size or is_header(data, end, size, length)


def hidden(data: memoryview, at: int, end: int, size: int, length: Ints) -> int:
    """Find a record inside ``(at, end)`` with a better claim to these bytes than that at `at`, or -1."""
    found = -1
    inner, stop = next_header(data, at, size, length), min(end, size - 2)
    while inner < stop:
        if is_chained(data, inner, size, length):
            found = inner
            stop = min(inner + length[data[inner + 2]], size - 2)  # which may itself hide a better one
        inner = next_header(data, inner, size, length)
    return found if found < end else -1


def next_header(data: memoryview, at: int, size: int, length: Ints) -> int:
    """Find where a known message type begins behind `at`; the end of the log if nowhere."""
    found = _header_of(length.tobytes()).search(data, at + 1)
    return found.start() if found else size


@lru_cache(maxsize=512)
def _header_of(lengths: bytes) -> re.Pattern[bytes]:
    width = len(lengths) // 256
    known = bytes(kind for kind in range(256) if any(lengths[width * kind : width * (kind + 1)]))
    return re.compile(b"\xa3\x95[" + re.escape(known) + b"]")


def is_new(data: memoryview, at: int, defined: Ints) -> bool:
    """Tell whether the definition at `at` differs from the one in force."""
    before = defined[data[at + 3]]
    return before < 0 or data[before : before + FMT_SIZE] != data[at : at + FMT_SIZE]


def read_time(data: memoryview, at: int, kind: int) -> int:
    """Read the first column of the record at `at` [us]: stored in us (kind 1) or ms (kind 2)."""
    low = data[at + 3] + (data[at + 4] << 8) + (data[at + 5] << 16) + (data[at + 6] << 24)
    if kind == 2:
        return int(low) * 1000
    if data[at + 9] != 0 or data[at + 10] != 0:  # more than eight years
        return NO_TIME
    high = data[at + 7] + (data[at + 8] << 8)
    return int(low) + (int(high) << 32)


def put(events: Ints, a: int, b: int, c: int, d: int) -> None:
    """Append four numbers to a list whose first element is its fill; drop them when it is full."""
    n = events[0]
    if n + 4 < len(events):
        events[n + 1], events[n + 2], events[n + 3], events[n + 4] = a, b, c, d
        events[0] = n + 4


def settle(state: Ints, steps: Ints) -> None:
    """Believe the waiting time stamps: the clock did jump, or nothing was logged for a while."""
    clock = state[CLOCK]
    for i in range(state[PENDING]):
        time = state[WAITING_US + i]
        if clock != NO_TIME and (time - clock > GAP_US or time - clock < -BACK_US):
            put(steps, state[WAITING_AT + i], clock, time, 0)
        if clock == NO_TIME or time > clock or time - clock < -BACK_US:
            clock = time
    state[CLOCK] = clock
    state[PENDING] = 0


def finish(state: Ints, odd: Ints, steps: Ints) -> None:
    """At the end of the log: fewer than `CONFIRM` records may tell of a gap, but not of a reboot."""
    if state[PENDING] > 0 and state[CLOCK] != NO_TIME and state[WAITING_US] < state[CLOCK]:
        reject(state, odd)
    settle(state, steps)


def reject(state: Ints, odd: Ints) -> None:
    """Disbelieve the waiting time stamps: they came and went, so those records are damaged."""
    for i in range(state[PENDING]):
        put(odd, state[WAITING_AT + i], 0, 0, 0)
    state[PENDING] = 0


def watch(time: int, at: int, state: Ints, odd: Ints, steps: Ints) -> None:
    """Follow the vehicle's clock; an unlikely step waits until `CONFIRM` records agree on it."""
    if time == NO_TIME:
        put(odd, at, 0, 0, 0)
        return
    step = time - state[CLOCK]
    if state[CLOCK] != NO_TIME and -BACK_US <= step <= GAP_US:
        if state[PENDING] > 0:
            reject(state, odd)
        if step > 0:
            state[CLOCK] = time
        return
    if state[PENDING] > 0:
        step = time - state[WAITING_US + state[PENDING] - 1]
        if step < -BACK_US or step > AHEAD_US:
            reject(state, odd)
    n = state[PENDING]
    state[WAITING_US + n] = time
    state[WAITING_AT + n] = at
    state[PENDING] = n + 1
    if n + 1 == CONFIRM:
        settle(state, steps)


def walk(
    data: memoryview, length: Ints, clock: Ints, defined: Ints, state: Ints, offsets: Ints, types: Ints,
    bad: Ints, odd: Ints, steps: Ints,
) -> tuple[int, int]:  # fmt: skip
    """Walk on from ``state[AT]``; return why it stopped and how many records it put into `offsets`.

    `data` (shape (size,)): the log. `length`, `clock`, `defined` (shape (256,)): per type: length of a record [bytes]
    (0: unknown), kind of time stamp (0: none), and where the definition in force stands. `offsets`, `types` (shape
    (BATCH,)): filled with the beginning and the type of each record. `bad`, `odd`, `steps`: filled, four numbers each,
    with damaged stretches (start, end, kind, clock), records with a wrong time stamp (start) and steps of the clock
    (start, from, to).
    """
    size, at, n = len(data), state[AT], 0
    room = len(bad) - 8
    doubt = False  # right behind damage, no sound record before it confirms a record
    while at + 3 <= size and n < len(offsets) and max(bad[0], odd[0] + 16, steps[0] + 16) < room:
        if not is_header(data, at, size, length):
            start, at = at, next_header(data, at, size, length)
            put(bad, start, at, BAD_HEADER, state[CLOCK])
            doubt = True
            continue
        kind = data[at + 2]
        end = at + length[kind]
        if doubt or (end != size and not is_header(data, end, size, length)):
            inner = hidden(data, at, end, size, length)
            if inner >= 0 or end > size:
                stop = inner if inner >= 0 else size
                put(bad, at, stop, BAD_CUT if inner >= 0 else BAD_TAIL, state[CLOCK])
                at = stop
                continue
        doubt = False
        if kind == FMT_TYPE and at != state[DONE_FMT] and not state[SETTLED] and is_new(data, at, defined):
            state[AT] = at
            return NEW_FORMAT, n
        offsets[n] = at
        types[n] = kind
        n += 1
        if clock[kind] > 0:
            watch(read_time(data, at, clock[kind]), at, state, odd, steps)
        at = end
    if at < size and at + 3 > size:
        put(bad, at, size, BAD_TAIL, state[CLOCK])
        at = size
    state[AT] = at
    return (END if at >= size else FULL), n


def stride(
    data: memoryview, length: Ints, clock: Ints, defined: Ints, state: Ints, stop: int
) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Offsets and types of the records from ``state[AT]`` up to `stop` that `walk` would take without a word.

    Arguments as of `walk`; the state moves on behind them.
    """
    raw, lengths, clocks = (
        np.frombuffer(data, np.uint8),
        np.frombuffer(length, np.int64),
        np.frombuffer(clock, np.int64),
    )
    size, begin = raw.size, state[AT]
    none = np.zeros(0, np.int64), np.zeros(0, np.uint8)
    if state[PENDING] > 0 or state[CLOCK] == NO_TIME or stop - begin < 3:
        return none
    piece = raw[begin:stop]
    at = np.flatnonzero((piece[:-2] == 0xA3) & (piece[1:-1] == 0x95))
    kinds = piece[at + 2]
    known = lengths[kinds] > 0
    at, kinds = at[known], kinds[known]
    if not at.size or at[0] != 0:
        return none
    sound = _chained(at, at + lengths[kinds], size - begin)
    at, kinds = at[sound] + begin, kinds[sound]
    for k in () if state[SETTLED] else np.flatnonzero(kinds == FMT_TYPE).tolist():
        if at[k] != state[DONE_FMT] and is_new(data, int(at[k]), defined):
            at, kinds = at[:k], kinds[:k]
            break
    timed = np.flatnonzero(clocks[kinds])
    times = _times(raw, at[timed], clocks[kinds[timed]])
    latest = np.maximum.accumulate(np.concatenate([[state[CLOCK]], times]))
    step = times - latest[:-1]
    odd = np.flatnonzero((times == NO_TIME) | (step < -BACK_US) | (step > GAP_US))
    taken = int(timed[odd[0]]) if odd.size else at.size
    state[CLOCK] = int(latest[odd[0] if odd.size else -1])
    if taken:
        state[AT] = int(at[taken - 1] + lengths[kinds[taken - 1]])
    return at[:taken], kinds[:taken]


def _chained(at: NDArray[np.int64], ends: NDArray[np.int64], size: int) -> NDArray[np.int64]:
    """Which of the places that look like records are a chain from the first on, each confirmed by the next."""
    broken = np.flatnonzero(ends[:-1] != at[1:])
    runs, first = [], 0
    while first < at.size:
        place = int(np.searchsorted(broken, first))
        last = int(broken[place]) if place < broken.size else at.size - 1
        follower = int(np.searchsorted(at, ends[last]))
        is_followed = ends[last] == size or (follower < at.size and at[follower] == ends[last])
        runs.append(np.arange(first, last + is_followed))
        first = follower if is_followed else at.size
    return np.concatenate(runs)


def _times(raw: NDArray[np.uint8], at: NDArray[np.int64], kinds: NDArray[np.int64]) -> NDArray[np.int64]:
    """As `read_time`, of many records."""
    times = np.zeros(at.size, np.int64)
    for kind, dtype in ((1, np.dtype("<u8")), (2, np.dtype("<u4"))):
        of_kind = kinds == kind
        anywhere = np.ndarray((max(raw.size - 3 - dtype.itemsize + 1, 0),), f"V{dtype.itemsize}", raw, 3, strides=(1,))
        ticks = anywhere[at[of_kind]].view(dtype)
        signed = ticks.astype(np.int64)
        times[of_kind] = signed * 1000 if kind == 2 else np.where(ticks >> 48, NO_TIME, signed)
    return times


def follow(times_us: Sequence[int], offsets: Sequence[int]) -> tuple[list[int], list[tuple[int, int, int]]]:
    """Follow a clock that was read already; for logs that are not walked byte by byte.

    `times_us`, `offsets`: time stamp [us] or `NO_TIME`, and place [bytes], of each record in the order of the file.
    """
    state = array("q", bytes(8 * STATE_SIZE))
    state[CLOCK] = NO_TIME
    odd, steps = (array("q", bytes(8 * 64)) for _ in range(2))
    odd_places: list[int] = []
    step_places: list[tuple[int, int, int]] = []

    def collect() -> None:
        odd_places.extend(odd[1 : odd[0] + 1 : 4])
        step_places.extend((steps[i], steps[i + 1], steps[i + 2]) for i in range(1, steps[0] + 1, 4))
        odd[0] = steps[0] = 0

    for time, at in zip(times_us, offsets, strict=True):
        watch(time, at, state, odd, steps)
        if odd[0] or steps[0]:
            collect()
    finish(state, odd, steps)
    collect()
    return odd_places, step_places


def clock_steps(
    times_us: Sequence[NDArray[np.int64]], offsets: Sequence[NDArray[np.int64]]
) -> tuple[NDArray[np.int64], list[tuple[int, int, int]]]:
    """Find gaps and jumps of a clock that several messages share, and records whose time stamp is wrong.

    `times_us`, `offsets` (shape (n_i,)): time stamps [us] or `NO_TIME`, and places, of the records of each message.
    Result: as of `follow`.
    """
    if not times_us:
        return np.zeros(0, np.int64), []
    places = np.concatenate(offsets)
    order = np.argsort(places, kind="stable")
    places, times = places[order], np.concatenate(times_us)[order]
    step = np.diff(times)
    if not times.size or (times.min() >= 0 and (not step.size or (step.min() >= -BACK_US and step.max() <= GAP_US))):
        return np.zeros(0, np.int64), []
    odd, steps = follow(times.tolist(), places.tolist())
    return np.array(odd, np.int64), steps


@dataclass
class Walk:
    """One walk over one log: its tables, its buffers, and where it stands.

    `data`: the log. `strides`: False walks record by record.
    """

    data: memoryview
    strides: bool = True
    length: array[int] = field(default_factory=lambda: array("q", bytes(8 * 256)))
    clock: array[int] = field(default_factory=lambda: array("q", bytes(8 * 256)))
    defined: array[int] = field(default_factory=lambda: array("q", [-1]) * 256)
    state: array[int] = field(default_factory=lambda: array("q", bytes(8 * STATE_SIZE)))

    def __post_init__(self) -> None:
        self.state[DONE_FMT] = -1
        self.state[CLOCK] = NO_TIME
        self.offsets = np.zeros(min(BATCH, len(self.data) // 4 + 16), np.int64)
        self.types = np.zeros(self.offsets.size, np.uint8)
        self.bad, self.odd, self.steps = (array("q", bytes(8 * (4 * EVENTS + 1))) for _ in range(3))
        self._stride = STRIDE[0]

    def run(self) -> tuple[int, int]:
        """Walk on; return why it stopped (`FULL`, `NEW_FORMAT`, `END`) and how many records it found."""
        for events in (self.bad, self.odd, self.steps):
            events[0] = 0
        n = self._strode() if self.strides else 0
        return (FULL, n) if n else self._stepped()

    def _strode(self) -> int:
        stop = min(self.state[AT] + self._stride, len(self.data))
        at, kinds = stride(self.data, self.length, self.clock, self.defined, self.state, stop)
        self.offsets[: at.size], self.types[: at.size] = at, kinds
        self._stride = min(self._stride << 3, STRIDE[1]) if self.state[AT] > stop - 256 else STRIDE[0]
        return at.size

    def _stepped(self) -> tuple[int, int]:
        few = A_FEW if self.strides else self.offsets.size
        tables = (self.length, self.clock, self.defined, self.state)
        return walk(self.data, *tables, self.offsets[:few], self.types[:few], self.bad, self.odd, self.steps)
