"""Channels of large logs: names first, numbers when they are looked up."""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from logparsers import clock
from logparsers.errors import EmptyLog, MissingChannel
from logparsers.records import Channel, Damage, FlightLog, own

if TYPE_CHECKING:
    from logparsers.only import Only
    from logparsers.records import FloatArray

MOST_CHANNELS = 50_000
"""Of one log: the richest have some ten thousand, forged ones a new name in every message."""
MOST_NOTES = 100
"""Groups of channels whose rows are out of order and that are listed one by one."""
OFTEN = 0.01
"""Messages with less than this share of the rows of the most frequent one do not tell when a flight begins and ends."""

_SAID = ("parameters", "texts", "vehicle", "firmware", "start_utc", "changed")
"""What a recording says beside its channels, as in `FlightLog`."""


@dataclass(frozen=True, slots=True)
class Series:
    """Where the numbers of a channel are.

    `group`: message and instance: channels of one group share their rows, and so their time stamps. `field`: column of
    the group. `element`: of an array; None for a scalar. `unit`, `origin`: as in `Channel`.
    """

    group: Hashable
    field: str
    element: int | None
    unit: str
    origin: str


class Recording(Protocol):
    """What a file must tell so that its columns become channels."""

    def series(self) -> Mapping[str, Series]:
        """Every numeric series by the name of its channel."""

    def stamps(self, group: Any) -> tuple[FloatArray, NDArray[np.bool_] | None]:  # noqa: ANN401 - its own kind of key
        """Time of each row of a group in the order of the file [s], and which of them are sound (None: all)."""

    def values(self, series: Series) -> NDArray[Any]:
        """Numbers of a series in the order of the file, shape (n,)."""

    @property
    def damage(self) -> tuple[Damage, ...]:
        """All that is wrong with it but for rows out of order. It has `_SAID` as well."""


def as_float(values: NDArray[Any]) -> FloatArray:
    """Convert to float64; a signalling NaN in a damaged or forged message is just a NaN."""
    with np.errstate(invalid="ignore"):
        return values.astype(np.float64)


class Made(Mapping[str, Channel]):
    """Channels by name, each made when it is looked up."""

    def __init__(self, names: Collection[str], make: Callable[[str], Channel]) -> None:
        self._names, self._make = names, make

    def __getitem__(self, name: str) -> Channel:
        if name not in self._names:
            raise KeyError(name)
        return self._make(name)

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


class LazyChannels(Made):
    """Channels by name, each decoded when it is looked up; time stamps are kept, values are not.

    Rows that came late are sorted in, rows that came twice or with a wrong stamp are left out: `survey` counts them.

    `recording`: the file. `names`: a choice of its series; all if None.
    """

    def __init__(self, recording: Recording, names: Mapping[str, Series] | None = None) -> None:
        self._recording = recording
        found = recording.series() if names is None else names
        self._series, self._is_whole = dict(islice(found.items(), MOST_CHANNELS)), len(found) <= MOST_CHANNELS
        super().__init__(self._series, self._decoded)
        self._clocks: dict[Hashable, tuple[FloatArray, NDArray[np.intp] | None, Damage | None]] = {}

    def only(self, wanted: Only, path: Path, others: Iterable[str] = ()) -> LazyChannels:
        """Restrict to those that are wanted.

        `others`: messages of the file that are not among these channels, because they were not asked for.
        """
        if not self._series and (wanted.patterns is None or not others):
            raise EmptyLog(f"{path}: no message with numbers and a time stamp in it; was the log copied completely?")
        names = wanted.pick(self._series)
        if not names and wanted.patterns is not None:
            known = list(dict.fromkeys([*(name.partition(".")[0] for name in self._series), *others]))
            more = f" and {len(known) - 12} more" if len(known) > 12 else ""
            asked, some = ", ".join(wanted.patterns), ", ".join(known[:12])
            raise MissingChannel(f"{path}: no channel {asked}; the log has {some}{more}")
        chosen = LazyChannels(self._recording, {name: self._series[name] for name in names})
        chosen._is_whole = self._is_whole
        return chosen

    def _decoded(self, name: str) -> Channel:
        series = self._series[name]
        time_s, rows, _ = self._clock(series.group)
        values = self._recording.values(series)
        if rows is not None:
            values = values[rows]
        floats = as_float(values)
        floats.setflags(write=False)
        return Channel(name, time_s, floats, series.unit, series.origin)

    def survey(self) -> tuple[tuple[Damage, ...], tuple[float, float] | None]:
        """Look at the time stamps of all channels, and at no value.

        Result: `span_s`: first and last time stamp of the messages that come often [s]: one of a mission, minutes
        after the flight, makes it no longer. None if there is none.
        """
        found, spans = [], []
        labels = {series.group: name.rpartition(".")[0] for name, series in self._series.items()}
        for group, label in labels.items():
            time_s, _, damage = self._clock(group)
            if damage:
                found.append(replace(damage, note=f"{label}: {damage.note}"))
            if time_s.size:
                spans.append((time_s.size, float(time_s[0]), float(time_s[-1])))
        listed, rest = found[:MOST_NOTES], found[MOST_NOTES:]
        if rest:
            total = sum(damage.count for damage in rest)
            listed.append(Damage("out_of_order", f"{total} rows of {len(rest)} more messages", total))
        if not self._is_whole:
            listed.append(Damage("bad_format", f"more than {MOST_CHANNELS} channels; the rest is left out"))
        if not spans:
            return tuple(listed), None
        enough = OFTEN * max(size for size, _, _ in spans)
        flown = [(begin_s, end_s) for size, begin_s, end_s in spans if size >= enough]
        return tuple(listed), (min(begin_s for begin_s, _ in flown), max(end_s for _, end_s in flown))

    def _clock(self, group: Hashable) -> tuple[FloatArray, NDArray[np.intp] | None, Damage | None]:
        """Time stamps of a group, its rows in that order (None: all as they are), and what is wrong with them."""
        if group not in self._clocks:
            time_s, sound = self._recording.stamps(group)
            rows, damage = clock.rise(time_s, sound)
            if damage is None:
                self._clocks[group] = own(clock.apart(time_s)), None, None
            else:
                self._clocks[group] = own(clock.apart(time_s[rows])), rows, damage
        return self._clocks[group]


def recorded_log(recording: Recording, path: Path, kind: str, only: Only, others: Iterable[str] = ()) -> FlightLog:
    """Log of a recording, whose channels are decoded when they are looked up.

    `path`, `kind`: as in `FlightLog`. `others`: as for `LazyChannels.only`.
    """
    channels = LazyChannels(recording).only(only, path, others)
    disorder, span_s = channels.survey()
    said = {name: getattr(recording, name) for name in _SAID}
    return FlightLog(path, kind, channels, (*recording.damage, *disorder), span_s=span_s, **said)
