"""Which channel of a log holds the current of which servo."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping
from typing import Final, Literal, NamedTuple

import numpy as np

from logparsers.records import FlightLog
from servofd.aircraft.current import AMPERES, CurrentSource
from servofd.aircraft.marks import refresh_of
from servofd.aircraft.outputs import counts_from_1, output_of
from servofd.aircraft.schema import Aircraft, Surface
from servofd.aircraft.series import SURROUNDINGS, signal_of
from servofd.core.errors import NoMeasurement
from servofd.core.types import BoolArray, FloatArray

_VOLTS: Final = {"mV": 1e-3, "cV": 1e-2}
"""Volts for each unit in which MAVLink reports batteries and rails."""
_BESIDE = {"CSRV": ("A", "V"), "VOLZ": ("pc", "pv"), "CVOL": ("Cur", "V"), "UMSV": ("Curr", "")}
"""Fields of the messages with which servos report themselves: current [A] and supply [V]."""
_HUB = re.compile(r"CSRV\[(\d+)\]\.A")
"""What hubs report of ordinary servos as well, which have no position."""
_SENT = re.compile(r"(?:.*:)?(?:NVF|NVAL|NAMED_VALUE_FLOAT)\[SRVA(\d+)\]\.[vV]alue")
"""What a script sends of them, by the number of the output [A]."""
_RAIL = re.compile(
    r"(?:.*:)?(?:CSCU\[\d+\]\.(?:A|Curr)|BAT\[[1-9]\d*\]\.Curr|BATTERY_STATUS\[[1-9]\d*\]\.current_battery"
    r"|battery_status\[[1-9]\d*\]\.current_a)"
)
"""Currents of circuits, and of batteries beside the first, which turns the propeller: of no servo by their names."""
_UNITS: Final[dict[str, Literal["A", "mA"]]] = {"_current_a": "A", "_current_ma": "mA"}
_EARLY = 0.1
"""Share of a refresh by which the next one may come early."""
_MOST_A, _MOST_OF_ONE_A, _SELDOM = 100.0, 25.0, 0.01
"""More than the servos of an aircraft of this size draw, and than one of them does, stalled ones of the largest less
than 20 A [A]; and the share of readings that may be none."""
_ASK = (
    'say in which unit (a column <surface>_current_ma, or unit = "mA" or "cA" in the aircraft file); counts have to be '
    "converted"
)
_REVERSED = 2.0
"""Times as far below zero as above it that a sensor reads which is wired the wrong way round."""
_OFTEN, _PILED = 0.05, 2.0
"""Share of readings at the end of a range, and how many times as many as at the step before."""


class CurrentChannel(NamedTuple):
    """Readings of a current that are numbers."""

    time_s: FloatArray
    current_a: FloatArray
    voltage_s: FloatArray
    voltage_v: FloatArray
    notes: tuple[str, ...]


def hub_outputs(log: FlightLog) -> dict[int, str]:
    """Channels of currents by the number of the output that they belong to, from 1.

    Ids start at 0 on one bus and at 1 on another: the bit mask of the driver tells which.
    """
    found, sent = (
        {int(of[1]): name for name in log.channels if (of := pattern.fullmatch(name)) and _has_numbers(log, name)}
        for pattern in (_HUB, _SENT)
    )
    base = 0 if counts_from_1(log.parameters, found) else 1
    return sent | {number + base: name for number, name in found.items()}


def current_sources(log: FlightLog, aircraft: Aircraft) -> tuple[dict[str, CurrentSource], dict[str, str]]:
    """Where a log holds the current of each surface, for those whose it does; and why a column is none, of others.

    What the aircraft file names comes first, then a column of the surface's name, then what the servo, or a hub,
    reports of its output; of a table with one surface, the current of the servo. Columns that read the same throughout
    are one channel, of several servos.

    Examples
    --------
    >>> import logparsers
    >>> from servofd.aircraft.schema import load_aircraft
    >>> log = logparsers.read("sample_logs/ardupilot_volz_stuck.bin")
    >>> current_sources(log, load_aircraft("simulated"))[0]["rudder"].channel
    'CSRV[3].A'
    """
    found: dict[str, CurrentSource] = {}
    unfit: dict[str, str] = {}
    hubs = hub_outputs(log)
    shared = next((f"servo{end}" for end in _UNITS if f"servo{end}" in log.channels), "")
    for name, surface in aircraft.surfaces.items():
        stem, dot, _ = ("" if surface.measured is None else surface.measured.channel).rpartition(".")
        fields = _BESIDE.get(stem.partition("[")[0], ("", ""))
        own = {f"{name}{end}": unit for end, unit in _UNITS.items()}
        bare = [f"{name}_current"]
        if len(aircraft.surfaces) == 1 and not any(each in log.channels for each in own):
            own |= {f"servo{end}": unit for end, unit in _UNITS.items()} | {"amps": "A"}
            bare += ["servo_current", "current"]
        column = next((each for each in own if each in log.channels), "")
        number = output_of(surface)
        if surface.current is not None:
            found[name] = surface.current
        elif column:
            volts = f"{column.rpartition('_current_')[0]}_voltage_v"
            found[name] = CurrentSource(channel=column, unit=own[column], voltage=_if_there(log, volts))
        elif dot and fields[0] and _has_numbers(log, f"{stem}.{fields[0]}"):
            current, volts = (f"{stem}.{each}" for each in fields)
            found[name] = CurrentSource(channel=current, unit="A", voltage=_if_there(log, volts))
        elif number is not None and number in hubs:
            volts = f"{hubs[number].rpartition('.')[0]}.V"
            found[name] = CurrentSource(channel=hubs[number], unit="A", voltage=_if_there(log, volts))
        elif why := _why_none(log, surface, bare, shared):
            unfit[name] = why
    return _together(log, found), unfit


def _why_none(log: FlightLog, surface: Surface, bare: Iterable[str], shared: str) -> str:
    """Why a column that may be a surface's current is none: one of `bare` names, or `shared` by several; or nothing."""
    unitless = next((each for each in bare if each in log.channels), "")
    if unitless:
        return (
            f"column {unitless} has no unit: call it <surface>_current_a or <surface>_current_ma, or name channel "
            "and unit in [surfaces.<surface>.current] of the aircraft file"
        )
    if shared and (surface.measured is None or surface.measured.channel not in log.channels):
        return (
            f"column {shared} is a current of no surface by name: say in [surfaces.<surface>.current] of an "
            "aircraft file which servos it feeds, and calibrate them on good flights to tell them apart"
        )
    return ""


def _together(log: FlightLog, found: Mapping[str, CurrentSource]) -> dict[str, CurrentSource]:
    """The same sources; columns that read the same are one channel, which is a current of several servos."""
    first: dict[tuple[str, bytes | str], str] = {}
    for source in found.values():
        first.setdefault(_readings(log, source), source.channel)
    return {
        name: source.model_copy(update={"channel": first[_readings(log, source)]}) for name, source in found.items()
    }


def _readings(log: FlightLog, source: CurrentSource) -> tuple[str, bytes | str]:
    """What a channel reads, and its unit; its name in place of readings that never change."""
    values = log[source.channel].values if source.channel in log.channels else np.zeros(0)
    is_one = np.unique(values[np.isfinite(values)]).size < 2
    return source.unit, source.channel if is_one else values.tobytes()


def rails_of(log: FlightLog, named: Collection[str] = ()) -> str:
    """What to do with currents that may feed servos and that no aircraft file has `named`; empty if there are none."""
    rails = [name for name in log.channels if _RAIL.fullmatch(name) and name not in named and _has_numbers(log, name)]
    if not rails:
        return ""
    what = f"{', '.join(rails)} {'is a current' if len(rails) == 1 else 'are currents'} of no servo by name"
    return f"{what}: say in [surfaces.NAME.current] of an aircraft file which servo it feeds, and it is judged by it"


def with_current_sources(log: FlightLog, aircraft: Aircraft) -> Aircraft:
    """The same aircraft, whose surfaces name where a log holds their currents, and no position that it lacks."""
    surfaces = dict(aircraft.surfaces)
    for name, source in current_sources(log, aircraft)[0].items():
        measured = surfaces[name].measured
        is_there = measured is not None and measured.channel in log.channels
        change = {"current": source, "measured": measured if is_there else None}
        surfaces[name] = surfaces[name].model_copy(update=change)
    return aircraft.model_copy(update={"surfaces": surfaces})


def read_current(log: FlightLog, source: CurrentSource) -> CurrentChannel:
    """Read a current and the supply beside it.

    Raises `NoMeasurement` if the channel is none, in words.
    """
    if source.channel not in log.channels:
        raise NoMeasurement(f"no current: the log has no channel {source.channel!r}")
    channel = log[source.channel]
    if channel.unit in AMPERES and channel.unit != source.unit:
        raise NoMeasurement(
            f"current channel {source.channel!r} is in {channel.unit} by its log, and in {source.unit} by the aircraft "
            "file: one of them is wrong"
        )
    good = np.isfinite(channel.values)
    if np.count_nonzero(good) < 2:
        raise NoMeasurement(f"current channel {source.channel!r} holds no value")
    time_s, current_a = channel.time_s[good], source.scale * channel.values[good]
    if np.ptp(current_a) == 0.0:
        raise NoMeasurement(
            f"current channel {source.channel!r} never changes (always {current_a[0]:g} A): not a measurement, or a "
            "servo that had no power throughout"
        )
    fresh = _fresh(time_s, current_a)
    time_s, current_a = time_s[fresh], current_a[fresh]
    notes = []
    is_of_one = source.channel.endswith(tuple(_UNITS)) and not source.channel.startswith("servo")
    most_a = _MOST_OF_ONE_A if is_of_one else _MOST_A
    absurd = np.abs(current_a) > most_a
    if float(np.mean(absurd)) > _SELDOM:
        up_to_a = f"{np.abs(current_a).max():.4g} A"
        raise NoMeasurement(f"current channel {source.channel!r} reads up to {up_to_a}, which no servo draws: {_ASK}")
    if source.unit == "A" and np.array_equal(current_a, np.round(current_a)):
        raise NoMeasurement(
            f"current channel {source.channel!r} reads whole amperes alone, which no sensor of a servo does: {_ASK}"
        )
    if absurd.any():
        notes.append(f"{np.count_nonzero(absurd)} of its currents are beyond {most_a:g} A and left out")
        time_s, current_a = time_s[~absurd], current_a[~absurd]
    low_a, high_a = np.quantile(current_a, (_SELDOM, 1.0 - _SELDOM)).tolist()
    if -low_a > _REVERSED * max(high_a, 0.0) and float(np.mean(current_a)) < 0.0:
        raise NoMeasurement(
            f"current channel {source.channel!r} falls to {low_a:.2g} A where others rise, to {high_a:.2g} A at most: "
            "its sensor is wired the wrong way round"
        )
    steps, counts = np.unique(current_a, return_counts=True)
    if counts[-1] > max(_OFTEN * current_a.size, _PILED * counts[-2]):
        share = counts[-1] / current_a.size
        notes.append(f"its current reads {steps[-1]:.3g} A in {share:.0%} of its readings: the end of its range")
    return CurrentChannel(time_s, current_a, *_volts(log, source.voltage), tuple(notes))


def _volts(log: FlightLog, name: str) -> tuple[FloatArray, FloatArray]:
    """Times [s] and readings [V] of a channel; empty if the log has none of that name."""
    return signal_of(log, {name: _VOLTS.get(log[name].unit, 1.0)} if name in log.channels else {})


def supplies(log: FlightLog, aircraft: Aircraft) -> list[tuple[FloatArray, FloatArray]]:
    """Times [s] and readings [V] of the rail of all servos, of columns of their own, and beside their currents."""
    beside = {source.voltage: None for source in current_sources(log, aircraft)[0].values() if source.voltage}
    names = beside | {f"{name}_voltage_v": None for name in aircraft.surfaces}
    found = [signal_of(log, SURROUNDINGS["servo_voltage_v"]), *(_volts(log, name) for name in names)]
    return [one for one in found if one[0].size]


def _fresh(time_s: FloatArray, current_a: FloatArray) -> BoolArray:
    """Rows with a reading of their own, (m,): some servos measure more seldom than they report, and repeat in between.

    Examples
    --------
    >>> time_s = np.arange(0.0, 20.0, 0.1)
    >>> held_a = np.sin(time_s)[4 * (np.arange(200) // 4)]
    >>> int(_fresh(time_s, held_a).sum()), int(_fresh(time_s, np.sin(time_s)).sum())
    (50, 200)
    """
    refresh_s = refresh_of(time_s, current_a)
    if refresh_s <= 0.0:
        return np.ones(time_s.size, dtype=bool)
    changed = np.diff(current_a, prepend=np.nan) != 0.0
    since_s = time_s - time_s[np.maximum.accumulate(np.where(changed, np.arange(time_s.size), 0))]
    slot = np.floor(since_s / refresh_s + _EARLY)
    fresh: BoolArray = changed | (np.diff(slot, prepend=-1.0) > 0.0)
    return fresh


def _has_numbers(log: FlightLog, name: str) -> bool:
    return name in log.channels and bool(np.count_nonzero(np.isfinite(log[name].values)) > 1)


def _if_there(log: FlightLog, name: str) -> str:
    return name if _has_numbers(log, name) else ""
