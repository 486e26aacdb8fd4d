"""Series: what was asked of one surface, what it did, on true time stamps, and which samples count.

Logs meet aircraft here. What is no measurement is marked once (`servofd.aircraft.marks` has the rules), and no verb
looks for it again.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from logparsers.errors import MissingChannel
from logparsers.mavlink import dialect
from logparsers.records import Channel, FlightLog, own
from servofd.aircraft.marks import LAST_WITH_VALUE, NO_OTHERS, Rows, Why, is_mostly_echo, marked, refresh_of, unanswered
from servofd.aircraft.pace import OUTAGE_S, WARM_UP_STEPS, link_period_s, pace_steps
from servofd.aircraft.watch import Bus, New
from servofd.core.errors import NoMeasurement
from servofd.core.series import latest, stretches
from servofd.core.types import BoolArray, FloatArray, Marks
from servofd.servo.context import NO_CONTEXT, Context

if TYPE_CHECKING:
    from servofd.aircraft.schema import Aircraft, Surface

FINEST_S: Final = 0.01
"""Time between measurements below which more of them tell nothing new of a servo, whose lag is longer [s]."""
_STANDS_S: Final = 1.0
"""A bus that is silent for so long stands still; the last row of a log may as well be one that came late [s]."""
_LARGEST_DEG = 1e6
"""No servo turns so far; a motor drive in millimetres may."""

SURROUNDINGS: Final[Mapping[str, Mapping[str, float]]] = {
    "airspeed_m_s": dict.fromkeys(
        (
            *("airspeed_m_s", "ARSP[0].Airspeed", "ARSP.Airspeed", "CTUN.As", "VFR_HUD.airspeed"),
            *("airspeed_validated[0].calibrated_airspeed_m_s", "airspeed_validated[0].equivalent_airspeed_m_s"),
        ),
        1.0,
    ),
    "servo_voltage_v": {"servo_voltage_v": 1.0, "volts": 1.0, "POWR.VServo": 1.0, "POWER_STATUS.Vservo": 1e-3},
    "servo_current_a": {"servo_current_a": 1.0, "amps": 1.0},
    "servo_temperature_c": {"servo_temperature_c": 1.0, "temp_c": 1.0},
    "servo_load": dict.fromkeys(
        ("servo_load", "load_torque_nm", "load_nm", "load_force_n", "load_n", "load_current_a", "disturbance"), 1.0
    ),
}
"""Channels that tell about the surroundings of servos, the best first, and what turns each into m/s, V, A or °C.

A load is what pushes the shaft from outside, in any unit; what a servo says of its own effort is none.
"""
_MOSTLY_FRESH = 0.7
"""A telemetry that writes each answer twice or more leaves less of its rows; single late answers leave more."""
_WORDS: Final = {
    Why.HELD: "held values",
    Why.ECHO: "the command itself",
    Why.SPIKE: "spikes",
    Why.BOOT: "of another boot",
    Why.TORQUE_OFF: "without power",
}
"""Reasons that a verdict names; frozen telemetry and holes are reported by the second, repeats by their rate."""
_WORTH_TELLING: Final = 0.02
"""Share of the readings from which on it does: late answers of a bus leave out 1 % of a sound flight."""


class LeftOut(NamedTuple):
    """A stretch of measurements that do not count."""

    why: str
    """Name of a `Why`, in words."""
    start_s: float
    end_s: float

    @property
    def sentence(self) -> str:
        """The stretch and why it does not count, in words."""
        return f"{self.why} from {self.start_s:.1f} to {self.end_s:.1f} s"


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Command and measured deflection of one surface over one log.

    `command_s`, `command_deg` (shape (n,)): when each command was logged [s], rising, and what it asked for [deg], as
    the servo receives it. `measured_s`, `measured_deg` (shape (m,)): when the deflection was measured [s], rising, and
    what it was [deg]; NaN where it was not.
    """

    surface: str
    command_s: FloatArray
    command_deg: FloatArray
    measured_s: FloatArray
    measured_deg: FloatArray
    command_period_s: float | None = None
    """If given, the log holds fewer commands than the servo received, one in so long [s], and the command is taken to
    run straight between them. None: every command is in the log and holds until the next."""
    why: Marks = field(default_factory=lambda: np.zeros(0, dtype=np.int8))
    """Why each measurement does not count, a `Why`, shape (m,). Left out: none is marked."""
    context: Context = NO_CONTEXT
    """Airspeed, supply and current, as far as they were logged."""
    sent_period_s: float | None = None
    """If given, commands were sent at this period [s] over a link, on which some may be lost."""

    def __post_init__(self) -> None:
        for name in ("command_s", "command_deg", "measured_s", "measured_deg"):
            object.__setattr__(self, name, own(getattr(self, name)))
        if self.command_s.shape != self.command_deg.shape or self.measured_s.shape != self.measured_deg.shape:
            raise ValueError(f"{self.surface}: times and values differ in number")
        if self.why.shape != self.measured_s.shape:
            if self.why.any():
                raise ValueError(f"{self.surface}: measurements and the reasons why they do not count differ in number")
            object.__setattr__(self, "why", np.zeros(self.measured_s.size, dtype=np.int8))

    @property
    def counts(self) -> BoolArray:
        """Measurements that count, shape (m,)."""
        counts: BoolArray = self.why == Why.COUNTS
        return counts

    @property
    def frozen_s(self) -> float:
        """For how long the bus, or this servo's telemetry, stood still [s]."""
        known = self.why != Why.MISSING
        step_s = np.diff(self.measured_s[known], append=self.measured_s[known][-1:])
        return float(step_s[self.why[known] == Why.FROZEN].sum())

    @property
    def frozen_to_end(self) -> bool:
        """Whether it stood still for the last second, or longer, and never came back."""
        others_s = self.measured_s[~np.isin(self.why, (Why.FROZEN, Why.MISSING))]
        froze = bool(self.why.size and self.why[-1] == Why.FROZEN)
        return froze and not (others_s.size and self.measured_s[-1] - others_s[-1] < _STANDS_S)

    @property
    def left_out_in_words(self) -> str:
        """How much of the readings is left out for which reason, in words; nothing of what is rare.

        Examples
        --------
        >>> t, why = np.arange(5.0), np.array([0, 0, 8, 7, 7], dtype=np.int8)
        >>> Series("rudder", t, t, t, t, why=why).left_out_in_words
        'left out: the command itself (40% of its readings), spikes (20%)'
        """
        read = self.why != Why.MISSING
        shares = {words: float(np.mean(self.why[read] == why)) if read.any() else 0.0 for why, words in _WORDS.items()}
        left = sorted(((share, words) for words, share in shares.items() if share >= _WORTH_TELLING), reverse=True)
        parts = [f"{words} ({share:.0%}{' of its readings' if not k else ''})" for k, (share, words) in enumerate(left)]
        return f"left out: {', '.join(parts)}" if parts else ""

    @property
    def left_out(self) -> tuple[LeftOut, ...]:
        """Stretches that do not count, and why; single rows that repeat or are missing are left out.

        Examples
        --------
        >>> t, why = np.arange(5.0), np.array([2, 0, 6, 6, 0], dtype=np.int8)
        >>> [each.sentence for each in Series("rudder", t, t, t, t, why=why).left_out]
        ['unsettled from 0.0 to 0.0 s', 'frozen from 2.0 to 3.0 s']
        """
        listed = ~np.isin(self.why, (Why.MISSING, Why.DUPLICATE, Why.HELD))
        time_s, marks = self.measured_s[listed], self.why[listed]
        found = [
            LeftOut(why.name.lower().replace("_", " "), float(time_s[a]), float(time_s[b - 1]))
            for why in Why
            if why != Why.COUNTS
            for a, b in stretches(marks == why)
        ]
        return tuple(sorted(found, key=lambda each: each.start_s))

    @property
    def repeats(self) -> BoolArray:
        """Rows that only repeat the one before, and are none of their own, shape (m,)."""
        repeats: BoolArray = (self.why == Why.DUPLICATE) | (self.why == Why.HELD)
        return repeats

    @property
    def refreshed(self) -> str:
        """A sentence, if positions came so much more seldom than rows that most of them only repeat; else nothing."""
        fresh_s = self.measured_s[~self.repeats]
        if fresh_s.size < 2 or fresh_s.size > _MOSTLY_FRESH * self.measured_s.size:
            return ""
        return (
            f"positions are refreshed every {float(np.median(np.diff(fresh_s))):.3g} s and held in between: each is "
            f"judged once ({fresh_s.size} of {self.measured_s.size} rows)"
        )

    def at(self, rows: BoolArray | slice, commands: BoolArray | slice = slice(None)) -> Series:
        """The same surface in some of its measurements and commands."""
        return replace(
            self,
            command_s=self.command_s[commands],
            command_deg=self.command_deg[commands],
            measured_s=self.measured_s[rows],
            measured_deg=self.measured_deg[rows],
            why=self.why[rows],
        )

    def coarser(self, finest_s: float = FINEST_S) -> Series:
        """The same surface with one measurement in so long at most [s]; those that do not count stay."""
        if not self.period_s < finest_s:
            return self
        counts = np.isfinite(self.measured_deg)
        return self.at(~counts | (np.cumsum(counts) % max(round(finest_s / self.period_s), 1) == 0))

    def with_commands(self, gain: float, offset_deg: float) -> Series:
        """The same surface with a command that was read in another scale."""
        return replace(self, command_deg=gain * self.command_deg + offset_deg)

    @property
    def duration_s(self) -> float:
        """Time from the first to the last measurement [s]."""
        return float(self.measured_s[-1] - self.measured_s[0]) if self.measured_s.size else 0.0

    @property
    def period_s(self) -> float:
        """Usual time between two measurements that have a value [s]; NaN if there are fewer than two."""
        steps_s = pace_steps(self.measured_s[np.isfinite(self.measured_deg)])
        return float(np.median(steps_s)) if steps_s.size else float("nan")


def too_far(segment: Series) -> str:
    """Which angle no servo reaches, or nothing: of a log `cut` refuses it, a damaged recording may hold it.

    Examples
    --------
    >>> t = np.arange(3) / 50.0
    >>> too_far(Series("x", t, 1e9 * t, t, t))
    'the command reaches 4e+07 deg: no servo turns so far'
    """
    for which, values_deg in (("command", segment.command_deg), ("position", segment.measured_deg)):
        largest_deg = float(np.nanmax(np.abs(values_deg), initial=0.0))
        if largest_deg > _LARGEST_DEG:
            return f"the {which} reaches {largest_deg:.3g} deg: no servo turns so far"
    return ""


UNSETTLED_S: Final = 1.0
"""After the first command and position the servo may still be on its way from an unknown place: a calibrated surface
has always been left alone for so long, and 66 of 75 healthy bench cycles that begin in motion were suspect without."""
_TORQUE = re.compile(r"(torque|servo|motor).*(enabled?|_on|power(ed)?)$|^powered$", re.IGNORECASE)
_STANDS_STILL = "all servos stopped reporting anything new while they were asked to move: look at the servo bus"


_STILL_S, _STILL_DEG_S, _THERE_DEG = 0.02, 10.0, 0.25
"""A servo that is no faster than this from its first reading to the next that is so much later, and stands where it is
asked to, began at rest: nothing is unknown of it. Less than the delay of the slowest hobby servo (0.03 s), more than a
period at 50 Hz; a servo at that speed is twice as far from where it would be at rest, after its lag of 0.05 s, as one
that turns back may be."""
FORGETS_S: Final = 0.5
"""Longest time for which a servo remembers how it began [s]. One that stands elsewhere and is asked nothing new was
asked at an unknown instant before, or was not powered: joints of an arm that began 27 to 42 deg away were up to 16 deg
from their model in the first 0.3 s, and 0.4 to 0.8 deg rms later."""


def settled_from_s(
    begun_s: float, commands: tuple[FloatArray, FloatArray], measured_s: FloatArray, measured_deg: FloatArray
) -> float:
    """From which instant on it is known what moves a servo [s]; infinite if its readings (n,) do not tell yet.

    Commands are their times [s] and what they ask for [deg], of shape (m,).

    Examples
    --------
    >>> t = np.arange(5.0)
    >>> still, moving = (t, np.zeros(5)), (t, 20.0 * t)
    >>> settled_from_s(0.5, still, t, np.zeros(5)), round(settled_from_s(0.5, still, *moving), 6)
    (2.0, 1.5)
    >>> round(settled_from_s(0.5, moving, t, np.zeros(5)), 6)
    1.5
    """
    later = np.flatnonzero((measured_s >= begun_s) & np.isfinite(measured_deg))
    late = later[measured_s[later] >= measured_s[later[0]] + _STILL_S] if later.size else later
    if not late.size:
        return float("inf")
    first, then = int(later[0]), int(late[0])
    asked_deg = latest(*commands, measured_s[[first, then]])
    still_deg = _STILL_DEG_S * float(measured_s[then] - measured_s[first])
    if abs(float(measured_deg[then] - measured_deg[first])) <= still_deg:
        if abs(float(measured_deg[first] - asked_deg[0])) <= _THERE_DEG:
            return float(measured_s[then])
        if asked_deg[0] == asked_deg[1]:
            return max(float(measured_s[then]), begun_s + FORGETS_S)
    return float(np.nextafter(begun_s + UNSETTLED_S, np.inf))


def is_unsettled(
    commands: tuple[FloatArray, FloatArray], measured_s: FloatArray, measured_deg: FloatArray, at_s: FloatArray
) -> BoolArray:
    """Whether instants are so early that what moved the servo before is not known, of shape (n,)."""
    begun_s = max(float(commands[0][0]), float(measured_s[0]))
    return at_s < settled_from_s(begun_s, commands, measured_s, measured_deg)


def bus_of(log: FlightLog, aircraft: Aircraft) -> dict[str, Marks]:
    """When the telemetry of an aircraft stood still, by surface, for each value of its position channel."""
    reported = {}
    for name, surface in aircraft.surfaces.items():
        if surface.measured is None or surface.measured.channel not in log.channels:
            continue
        measured = log[surface.measured.channel]
        known = np.isfinite(surface.measured.plain_deg(measured.values))
        if known.any() and not measured.is_constant:
            reported[name] = _reported(log, surface, measured, known)
    return Bus(list(reported)).take(reported, is_all=True)


def cut(log: FlightLog, name: str, aircraft: Aircraft, bus: Mapping[str, Marks] | None = None) -> Series:
    """Take one surface out of a log, in degrees, and mark what does not count.

    `aircraft`: of this surface, and of the others, which tell whether the bus stood still. `bus`: what `bus_of` says,
    for whoever takes several surfaces. Raises `NoMeasurement` if the log does not tell where the surface was, or what
    was asked of it; the message is the reason.

    Examples
    --------
    >>> import logparsers
    >>> from servofd.aircraft.schema import plain_aircraft
    >>> log = logparsers.read("sample_logs/table_three_faults.csv")
    >>> [each.sentence for each in cut(log, "rudder", plain_aircraft(["rudder"])).left_out]
    ['unsettled from 0.0 to 0.0 s']
    """
    surface = aircraft.surfaces[name]
    command = channel_of(log, surface.command.channel, "command")
    if surface.measured is None:
        raise NoMeasurement("no measured channel is known for this surface")
    measured = channel_of(log, surface.measured.channel, "position")
    if measured.is_constant:
        values = measured.values[np.isfinite(measured.values)]
        has = "holds a single value" if values.size == 1 else f"never changes (always {values[0]:g})"
        raise NoMeasurement(f"position channel {measured.name!r} {has}: not a measurement")
    command_s, command_deg = asked(surface, command)
    measured_deg = surface.measured.to_deg(measured.values)
    for channel, values_deg in ((command, command_deg), (measured, measured_deg)):
        largest_deg = float(np.nanmax(np.abs(values_deg)))
        if largest_deg > _LARGEST_DEG:
            raise NoMeasurement(
                f"channel {channel.name!r} reaches {largest_deg:.3g} deg: check its unit and calibration"
            )
    stands = (bus if bus is not None else bus_of(log, aircraft)).get(name)
    known = np.isfinite(measured_deg)
    rows, why, never_sent = _marks(log, name, surface, measured, known, stands)
    if is_mostly_echo(rows, why[known]):
        raise NoMeasurement("position equals command in every sample: an echo of the command, not a measurement")
    if np.count_nonzero((why <= LAST_WITH_VALUE) & known) < 2:
        frozen = bool(np.any(why == Why.FROZEN))
        raise NoMeasurement(_STANDS_STILL if frozen else "no position counts: " + _reasons(why))
    sent_s = link_period_s(command_s[: WARM_UP_STEPS + 1]) if is_streamed(log.format, command.name) else None
    return Series(
        name,
        command_s[~never_sent],
        command_deg[~never_sent],
        measured.time_s,
        np.where(why > LAST_WITH_VALUE, np.nan, measured_deg),
        surface.command_period_s,
        why=why,
        context=Context(
            *(
                column
                for kind, sources in SURROUNDINGS.items()
                for column in signal_of(log, _sources(kind, sources, name, surface))
            )
        ),
        sent_period_s=sent_s,
    )


def asked(surface: Surface, command: Channel) -> tuple[FloatArray, FloatArray]:
    """What a surface is asked: times [s] and deflections [deg], shape (n,) each.

    Raises `NoMeasurement` if the channel holds no command.
    """
    command_deg = surface.command.to_deg(command.values)
    given = np.isfinite(command_deg)
    if not given.any():
        raise NoMeasurement(f"command channel {command.name!r} holds no command (a pulse of 0 us is none)")
    if surface.command_saturation_deg is not None:
        command_deg = np.clip(command_deg, *surface.command_saturation_deg)
    return command.time_s[given], command_deg[given]


def _reasons(why: Marks) -> str:
    """How many rows are left out for which reason."""
    names = {each: int(np.count_nonzero(why == each)) for each in Why if each != Why.COUNTS}
    return ", ".join(f"{count} {each.name.lower().replace('_', ' ')}" for each, count in names.items() if count)


def _marks(
    log: FlightLog, name: str, surface: Surface, measured: Channel, known: BoolArray, stands: Marks | None
) -> tuple[Rows, Marks, BoolArray]:
    """Rows with a value, why each row of the log does not count, and commands that were never sent."""
    time_s = measured.time_s
    command_s, command_deg, read_s, read_deg, others = _reported(log, surface, measured, known)
    stands = np.zeros(read_s.size, dtype=np.int8) if stands is None else stands
    rows = Rows(read_s, read_deg, latest(command_s, command_deg, read_s), others, stands)
    never_sent = unanswered(command_s, command_deg, rows)
    asked_deg = latest(command_s[~never_sent], command_deg[~never_sent], read_s)
    rows = rows._replace(asked_deg=asked_deg, refresh_s=refresh_of(read_s, read_deg))
    why = np.full(time_s.size, Why.MISSING, dtype=np.int8)
    why[known], _ = marked(rows)
    last = np.searchsorted(command_s, time_s, side="right") - 1
    reasons = (
        (Why.UNSETTLED, is_unsettled((command_s, command_deg), rows.time_s, rows.position_deg, time_s)),
        (Why.GAP, (last < 0) | (time_s - command_s[np.maximum(last, 0)] > OUTAGE_S)),
        (Why.TORQUE_OFF, _without_torque(log, name, time_s)),
        (Why.BOOT, _of_another_boot(log, time_s)),
    )
    for reason, here in reasons:
        why[here & (why <= LAST_WITH_VALUE)] = reason
    return rows, why, never_sent


def _reported(log: FlightLog, surface: Surface, measured: Channel, known: BoolArray) -> New:
    """What a log holds of a surface, and whether other values of its telemetry changed with each position."""
    nothing = np.zeros(0)
    channel = log[surface.command.channel] if surface.command.channel in log.channels else None
    commands = (nothing, nothing) if channel is None else (channel.time_s, channel.values)
    new = New.of(surface, commands, (measured.time_s, measured.values))
    beside = [log[each] for each in surface.alive if each in log.channels]
    values = [each.values[known] for each in beside if np.array_equal(each.time_s, measured.time_s)]
    if not values:
        return new._replace(other=np.full(new.time_s.size, NO_OTHERS, dtype=np.int8))
    same = [(each[1:] == each[:-1]) | (np.isnan(each[1:]) & np.isnan(each[:-1])) for each in values]
    return new._replace(other=np.append(np.int8(1), ~np.all(same, axis=0)).astype(np.int8))


def _without_torque(log: FlightLog, name: str, time_s: FloatArray) -> BoolArray:
    """When a column says that the servo is not powered: its own, or else one that bears no surface's name."""
    names = [each for each in log.channels if _TORQUE.search(each.rsplit(".", 1)[-1])]
    own_first = [each for each in names if each.startswith(f"{name}_")] or names
    for each in own_first[:1]:
        channel = log[each]
        known = np.isfinite(channel.values)
        if known.any():
            return latest(channel.time_s[known], channel.values[known], time_s) <= 0.0
    return np.zeros(time_s.size, dtype=bool)


def _of_another_boot(log: FlightLog, time_s: FloatArray) -> BoolArray:
    """What does not belong to the longest flight of a log that was not divided at its boots."""
    boot = np.searchsorted(np.array(log.boots_s), time_s, side="right")
    if not boot.size or not boot.any():
        return np.zeros(time_s.size, dtype=bool)
    other: BoolArray = boot != np.bincount(boot).argmax()
    return other


def is_streamed(log_format: str, channel: str) -> bool:
    """Whether a channel came in messages of its own over a link."""
    name = channel.rpartition(":")[2].partition(".")[0].partition("[")[0]
    return log_format in ("tlog", "live") and name in dialect().layouts


def _sources(kind: str, sources: Mapping[str, float], name: str, surface: Surface) -> Mapping[str, float]:
    """Channels of one surface: a load is its own, and may have its name before it, or be named by its aircraft file."""
    if kind != "servo_load":
        return sources
    return {surface.load: 1.0} if surface.load else {f"{name}_{each}": 1.0 for each in sources} | dict(sources)


def signal_of(log: FlightLog, sources: Mapping[str, float]) -> tuple[FloatArray, FloatArray]:
    """Times and values of the first of these channels that holds any; empty if none does."""
    for name, scale in sources.items():
        if name in log.channels:
            channel = log[name]
            good = np.isfinite(channel.values)
            if np.count_nonzero(good) > 1:
                return channel.time_s[good], scale * channel.values[good]
    return np.zeros(0), np.zeros(0)


FLIES_M_S, _OF_USUAL, _CLIMBS_S = 5.0, 0.5, 5.0
"""An aircraft may fly that is faster than this [m/s], and has taken off once it is faster than half of its usual
airspeed, of what is, and stays so for so long [s]: slower than it can fly, faster than gusts on the ground."""


def take_off_s(log: FlightLog) -> float | None:
    """When an aircraft took off, by its airspeed [s]; None if the log does not tell, or begins in the air."""
    time_s, airspeed_m_s = signal_of(log, SURROUNDINGS["airspeed_m_s"])
    moving = airspeed_m_s > FLIES_M_S
    if not moving.any():
        return None
    fast = airspeed_m_s > _OF_USUAL * float(np.median(airspeed_m_s[moving]))
    for begin, end in stretches(fast):
        if time_s[end - 1] - time_s[begin] >= _CLIMBS_S:
            return float(time_s[begin]) if begin else None
    return None


def channel_of(log: FlightLog, name: str, kind: str) -> Channel:
    """A channel that holds values; `kind` says what is missing.

    Raises `NoMeasurement` if there is none of that name, or it is empty.
    """
    try:
        channel = log[name]
    except MissingChannel as error:
        draft = f"; 'servofd config {log.source}' drafts a file for such logs" if log.is_of_autopilot else ""
        raise NoMeasurement(f"no {kind}: " + str(error).removeprefix(f"{log.label}: ") + draft) from None
    if not np.any(np.isfinite(channel.values)):
        raise NoMeasurement(f"{kind} channel {name!r} holds no value")
    return channel
