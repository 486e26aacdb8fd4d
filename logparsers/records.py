"""What every reader returns: channels on their own time stamps, and the damage that was found."""

from __future__ import annotations

import difflib
import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from datetime import datetime
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from logparsers.errors import MissingChannel
from logparsers.only import Only

if TYPE_CHECKING:
    import pandas as pd

FloatArray = NDArray[np.float64]

_MOST_CELLS = 100_000_000
"""A larger table (0.8 GB) is a mistake: hundreds of channels that share no time stamps."""

_SHORTEST_FLIGHT_S = 3.0
"""What a vehicle logs between two boots in less is no flight."""


class Setting(NamedTuple):
    """A setting of the autopilot that became another one while the log ran."""

    time_s: float
    """When, on the time base of the log [s]."""
    name: str
    before: float
    value: float


def settings_changed(rows: Iterable[tuple[float, str, float]]) -> tuple[Setting, ...]:
    """Changes among settings as they were logged: when [s], which, and its value."""
    known: dict[str, float] = {}
    found = []
    for time_s, name, value in rows:
        before = known.setdefault(name, value)
        if before != value and not math.isnan(time_s):
            found.append(Setting(time_s, name, before, value))
        known[name] = value
    return tuple(found)


def rows_text(number: int) -> str:
    """Write a number of rows."""
    return f"{number} row" if number == 1 else f"{number} rows"


def own(values: ArrayLike) -> FloatArray:
    """Copy to a read-only float64 array, so that no record can change behind its owner's back.

    An array that is one already is shared: the channels of one message have one array of time stamps.

    Examples
    --------
    >>> stamps = own([1, 2])
    >>> stamps.flags.writeable, own(stamps) is stamps
    (False, True)
    """
    if (
        isinstance(values, np.ndarray)
        and values.dtype == np.float64
        and values.base is None
        and not values.flags.writeable
    ):
        return values  # it cannot be changed elsewhere either
    array: FloatArray = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


@dataclass(frozen=True, slots=True, eq=False)
class Channel:
    """One logged scalar series.

    Parameters
    ----------
    name : str
        Name within the log, for example ``"de_pos"``.
    time_s : ndarray, shape (n,)
        Time stamps [s], strictly increasing.
    values : ndarray, shape (n,)
        Samples in `unit`; NaN where the log has no value.
    unit : str
        Unit of `values` as it was logged: ``"deg"``, ``"rad"``, ``"us"``, ``"count"``, ``""`` if unknown.
    origin : str
        Where the values come from, for example ``"SERVO_OUTPUT_RAW.servo3_raw"``.

    Raises
    ------
    ValueError
        If the shapes differ.

    Examples
    --------
    >>> Channel("de", [0.0, 0.02], [0.1, 0.1], "rad", "de").is_constant
    True
    """

    name: str
    time_s: FloatArray
    values: FloatArray
    unit: str
    origin: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "time_s", own(self.time_s))
        object.__setattr__(self, "values", own(self.values))
        if self.time_s.ndim != 1 or self.time_s.shape != self.values.shape:
            raise ValueError(f"channel {self.name!r}: {self.time_s.shape} times, {self.values.shape} values")

    @property
    def is_constant(self) -> bool:
        """True if all finite values are equal, so that the channel measures nothing."""
        finite = self.values[np.isfinite(self.values)]
        return finite.size == 0 or bool(np.ptp(finite) == 0.0)


@dataclass(frozen=True, slots=True)
class Damage:
    """One defect of a log, kept instead of repaired in silence.

    Parameters
    ----------
    kind : str
        One of the words in the notes below.
    note : str
        What happened, in words, with numbers.
    count : int
        How much was lost or is concerned: samples, rows, cells or messages; bytes where the note says bytes.
    start_s, end_s : float or None
        Where it happened [s], if it can be placed.

    Notes
    -----
    Time: ``"gap"`` (nothing logged), ``"clock_jump"`` (the clock was set), ``"reboot"`` (the vehicle's clock began
    again), ``"arrival_jump"`` (the receiver's clock was set), ``"no_arrival_time"``, ``"out_of_order"`` (rows whose
    stamps do not rise, or that came twice; those that were left out are counted).

    Bytes: ``"corrupt"`` (no record can be read there), ``"bad_checksum"``, ``"truncated"`` (the file or a row ends
    early), ``"bad_format"`` (the log contradicts itself about its own layout), ``"unknown_message"``.

    Values: ``"non_finite"``, ``"not_numeric"``, ``"wrong_length"``.
    """

    kind: str
    note: str
    count: int = 1
    start_s: float | None = None
    end_s: float | None = None


@dataclass(frozen=True, slots=True)
class Text:
    """Something that was said in words.

    Parameters
    ----------
    time_s : float
        When, on the time base of the log [s]; NaN if the log does not say.
    text : str
        The words.
    severity : int or None
        0 emergency ... 7 debug; None if the log does not say.
    source : str
        Who, as ``"system/component"``; empty if there is only one.

    Examples
    --------
    >>> Text(12.5, "Throttle armed").severity is None
    True
    """

    time_s: float
    text: str
    severity: int | None = None
    source: str = ""


MOST_ALIKE = 3
"""Damage of the same wording that is listed one by one at most."""
_MESSAGE = re.compile(r"^\S+: ")


def _together(group: Sequence[Damage]) -> Damage:
    first = group[0]
    starts = [d.start_s for d in group if d.start_s is not None]
    ends = [d.end_s for d in group if d.end_s is not None]
    note = f"{len(group)} times, as in: {first.note}"
    return Damage(first.kind, note, sum(d.count for d in group), min(starts, default=None), max(ends, default=None))


_OF_AUTOPILOTS = frozenset({"dataflash", "tlog", "ulog"})


@dataclass(frozen=True, slots=True, eq=False)
class FlightLog:
    """One log, or one run of a bench file: what was recorded, and what is wrong with it.

    Parameters
    ----------
    source : Path
        The file.
    format : str
        ``"faser"``, ``"table"``, ``"dataflash"``, ``"tlog"`` or ``"ulog"``.
    channels : Mapping[str, Channel]
        By name, in the order of the file. In a log of an autopilot each is decoded when it is looked up.
    damage : tuple of Damage
        Everything that was found to be wrong.
    run : str
        Which experiment of a file that holds several; empty otherwise.
    parameters : Mapping[str, float]
        Settings of the autopilot by name, each with its last value.
    texts : tuple of Text
        What the vehicle and others said.
    vehicle : str
        Kind of aircraft, as MAVLink calls it (``"fixed wing"``); empty if the log does not say.
    firmware : str
        For example ``"ArduPlane V4.5.1 (1a2b3c4d)"`` or ``"PX4 1.15.0"``; empty if the log does not say.
    start_utc : datetime or None
        Date and time at ``time_s = 0``, when the vehicle was booted; None if the log does not say.
    span_s : tuple of float, or None
        First and last time of the flight [s]: messages that come once tell nothing of it. None: those of the channels.
    changed : tuple of Setting
        Settings of the autopilot that became other ones while the log ran, in order of time.
    """

    source: Path
    format: str
    channels: Mapping[str, Channel]
    damage: tuple[Damage, ...] = ()
    run: str = ""
    parameters: Mapping[str, float] = field(default_factory=dict)
    texts: tuple[Text, ...] = ()
    vehicle: str = ""
    firmware: str = ""
    start_utc: datetime | None = None
    span_s: tuple[float, float] | None = None
    changed: tuple[Setting, ...] = ()

    def __post_init__(self) -> None:
        channels = dict(self.channels) if isinstance(self.channels, dict) else self.channels  # a lazy one stays lazy
        object.__setattr__(self, "channels", MappingProxyType(channels))
        object.__setattr__(self, "parameters", MappingProxyType(dict(self.parameters)))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled with all its channels, each decoded."""
        values = (getattr(self, each.name) for each in fields(self))
        return FlightLog, tuple(dict(value) if isinstance(value, Mapping) else value for value in values)

    @property
    def is_of_autopilot(self) -> bool:
        """Whether outputs, positions and settings in it tell which surface each servo moves."""
        return self.format in _OF_AUTOPILOTS

    def __getitem__(self, name: str) -> Channel:
        """Channel by name.

        Raises `MissingChannel` if the log has no such channel; the message names the nearest ones.
        """
        try:
            return self.channels[name]
        except KeyError:
            near = difflib.get_close_matches(name, self.channels, n=3, cutoff=0.4)
            known = ", ".join(near or list(self.channels)[:12])
            raise MissingChannel(
                f"{self.label}: no channel {name!r}; it has {len(self.channels)}, among them {known}"
            ) from None

    def only(self, wanted: Only) -> FlightLog:
        """The same log with a choice of its channels.

        Raises
        ------
        MissingChannel
            If it has none of them.
        """
        if wanted.patterns is None:
            return self
        found = wanted.pick(self.channels)
        if not found:
            self[", ".join(wanted.patterns)]
        return replace(self, channels={name: self.channels[name] for name in found})

    @property
    def label(self) -> str:
        """File name, and the run where there are several."""
        return f"{self.source} (run {self.run})" if self.run else str(self.source)

    @property
    def duration_s(self) -> float:
        """From the first to the last time stamp of the flight [s]; decodes nothing."""
        first_s, last_s = self.ends_s
        return last_s - first_s

    @property
    def ends_s(self) -> tuple[float, float]:
        """First and last time stamp of the flight [s]: `span_s`, or those of the channels; 0 without any."""
        if self.span_s is not None:
            return self.span_s
        spans = [(float(c.time_s[0]), float(c.time_s[-1])) for c in self.channels.values() if c.time_s.size]
        return (min(s[0] for s in spans), max(s[1] for s in spans)) if spans else (0.0, 0.0)

    @property
    def damage_summary(self) -> tuple[Damage, ...]:
        """The same damage for people: what stands there more than `MOST_ALIKE` times in other numbers is one entry.

        Disorder of several messages is alike, whatever they are called.

        Examples
        --------
        >>> lost = [Damage("bad_checksum", f"{k} bytes at offset {9 * k}", k) for k in range(1, 8)]
        >>> [(d.note, d.count) for d in FlightLog(Path("a.tlog"), "tlog", {}, tuple(lost)).damage_summary]
        [('7 times, as in: 1 bytes at offset 9', 28)]
        """
        alike: dict[tuple[str, str], list[Damage]] = {}
        for damage in self.damage:
            words = _MESSAGE.sub("", damage.note) if damage.kind == "out_of_order" else damage.note
            alike.setdefault((damage.kind, re.sub(r"[\d.]+", "#", words)), []).append(damage)
        return tuple(
            each for group in alike.values() for each in (group if len(group) <= MOST_ALIKE else [_together(group)])
        )

    @property
    def boots_s(self) -> tuple[float, ...]:
        """When the vehicle was booted again, on the time base of the log [s]: what is before is another flight."""
        return tuple(d.end_s for d in self.damage if d.kind == "reboot" and d.end_s is not None)

    def by_boots(self) -> tuple[FlightLog, ...]:
        """The flights of the log, on its time base: a vehicle that is booted again begins another one.

        Examples
        --------
        >>> channel = Channel("RCOU.C1", np.arange(20.0), np.arange(20.0), "us", "")
        >>> reboot = Damage("reboot", "the clock starts again", 1, 9.0, 12.0)
        >>> log = FlightLog(Path("a.bin"), "dataflash", {"RCOU.C1": channel}, (reboot,))
        >>> [(one.run, one["RCOU.C1"].time_s.size, one.duration_s) for one in log.by_boots()]
        [('boot 1', 12, 9.0), ('boot 2', 8, 7.0)]
        """
        reboots = sorted((d.end_s, d.start_s) for d in self.damage if d.kind == "reboot" and d.end_s is not None)
        if not reboots:
            return (self,)
        first_s, last_s = self.ends_s
        begins_s = [first_s, *(end_s for end_s, _ in reboots)]
        ends_s = [*(end_s if start_s is None else start_s for end_s, start_s in reboots), last_s]
        edges_s = [-np.inf, *begins_s[1:], np.inf]
        parts = []
        for k, (begin_s, end_s) in enumerate(zip(begins_s, ends_s, strict=True)):
            if end_s - begin_s < _SHORTEST_FLIGHT_S:
                continue
            channels = {
                name: replace(channel, time_s=channel.time_s[rows], values=channel.values[rows])
                for name, channel in self.channels.items()
                for rows in [slice(*np.searchsorted(channel.time_s, edges_s[k : k + 2]).tolist())]
                if rows.start < rows.stop
            }
            damage = tuple(d for d in self.damage if d.start_s is None or edges_s[k] <= d.start_s < edges_s[k + 1])
            run = f"{self.run} boot {k + 1}".strip()
            parts.append(replace(self, channels=channels, damage=damage, run=run, span_s=(begin_s, end_s)))
        return tuple(parts) or (self,)

    def to_pandas(self, names: str | Sequence[str] | None = None) -> pd.DataFrame:
        """Put channels into one table, one row per time stamp.

        Parameters
        ----------
        names : str or sequence of str, optional
            Names, prefixes (``"RCOU"`` is all of that message) or patterns with ``*`` and ``?``; all channels if None.

        Returns
        -------
        pandas.DataFrame
            Index ``time_s`` [s], one column per channel; ``attrs["units"]`` has their units. Channels keep their own
            time stamps: a cell is NaN where its channel has no sample, and nothing is interpolated.

        Raises
        ------
        MissingChannel
            If one of the names fits no channel.
        ValueError
            If the table would have more than a hundred million cells.

        Examples
        --------
        >>> import logparsers
        >>> log = logparsers.read("sample_logs/faser_healthy_flight.mat")
        >>> log.to_pandas(["de", "de_pos"]).columns.tolist()
        ['de', 'de_pos']
        """
        wanted = Only.of(names)
        for pattern in wanted.patterns or ():
            if not Only.of(pattern).pick(self.channels):
                self[pattern]
        found = wanted.pick(self.channels)
        return _joined([self.channels[name] for name in found])

    def __repr__(self) -> str:
        kinds = Counter(d.kind for d in self.damage)
        damage = ", ".join(f"{n} {kind}" for kind, n in kinds.items()) or "no damage"
        return (
            f"<FlightLog {self.label}: {self.format}, {self.duration_s:.1f} s, {len(self.channels)} channels, {damage}>"
        )


def _joined(channels: Sequence[Channel]) -> pd.DataFrame:
    """Join channels on their time stamps: a row for each stamp of any channel, NaN where a channel has no sample."""
    import pandas as pd

    clocks = {id(channel.time_s): channel.time_s for channel in channels}
    time_s = np.unique(np.concatenate(list(clocks.values())))
    if time_s.size * len(channels) > _MOST_CELLS:
        raise ValueError(
            f"{len(channels)} channels on {time_s.size} time stamps make a table of {time_s.size * len(channels):.1e} "
            f"cells; name fewer channels, for example to_pandas({channels[0].name!r})"
        )
    rows = {key: np.searchsorted(time_s, stamps) for key, stamps in clocks.items()}
    columns = {}
    for channel in channels:
        column = np.full(time_s.size, np.nan)
        column[rows[id(channel.time_s)]] = channel.values
        columns[channel.name] = column
    table = pd.DataFrame(columns, index=pd.Index(time_s, name="time_s"), copy=False)
    table.attrs["units"] = {channel.name: channel.unit for channel in channels}
    return table
