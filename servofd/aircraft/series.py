"""Segments: what was asked of one surface and what it did, on true time stamps."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from logparsers.errors import MissingChannel
from logparsers.mavlink import dialect
from logparsers.records import own
from servofd.core.errors import NoMeasurement
from servofd.core.frozen import frozen_rows, republished_rows
from servofd.core.series import latest
from servofd.servo.context import NO_CONTEXT, Context

if TYPE_CHECKING:
    from collections.abc import Mapping

    from logparsers.records import Channel, FlightLog
    from servofd.aircraft.schema import Surface
    from servofd.core.types import FloatArray

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
OUTAGE_S = 1.0
"""Longer steps are pauses of a link."""
_FEWEST_STEPS, _SHORTEST, _WHOLE = 20, 10.0, 1.5
"""Where more than half is lost, the shortest steps (this percentile) are whole, and most of them are longer."""
WARM_UP_S, WARM_UP_STEPS = 10.0, 100
"""A monitor in flight learns the pace of a stream from so many intervals, or from as many as there are by then [s]."""
SAME_PACE, _STEPS_FOR_PACE = 1.5, 10_000

SLOWEST_RATE_HZ = 8.0
"""Feedback of nominally 10 Hz, whose pace jitters, is judged; below, samples are further apart than a servo takes for
5 deg (0.1 s at the slowest of the library), and a jam looks like a delay."""
SLOWEST_LEFT_HZ = 4.0
"""The same of a calibrated servo, whose delay is known, where only a link loses what would be more."""
TOO_MANY_LOST = "more than half of all commands and positions are lost; a servo that is not calibrated cannot be judged"


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Command and measured deflection of one surface over one log.

    Parameters
    ----------
    surface : str
        Name of the surface.
    command_s, command_deg : ndarray, shape (n,)
        When each command was logged [s], rising, and what it asked for [deg], as the servo receives it.
    measured_s, measured_deg : ndarray, shape (m,)
        When the deflection was measured [s], rising, and what it was [deg]; NaN where it was not.
    command_period_s : float or None
        If given, the log holds fewer commands than the servo received (one every `command_period_s`), and the
        command is taken to run straight between them. None: every command is in the log and holds until the next.

    Examples
    --------
    >>> Series("rudder", np.arange(3.0), np.zeros(3), np.arange(3.0), np.zeros(3)).duration_s
    2.0
    """

    surface: str
    command_s: FloatArray
    command_deg: FloatArray
    measured_s: FloatArray
    measured_deg: FloatArray
    command_period_s: float | None = None
    frozen_s: float = 0.0
    """Time during which a dead telemetry repeated its last row [s]; those rows are missing values here."""
    frozen_to_end: bool = False
    """True if it never came back."""
    context: Context = NO_CONTEXT
    """Airspeed, supply and current, as far as they were logged."""
    sent_period_s: float | None = None
    """If given, commands were sent at this period [s], and most of them were lost on the way."""

    def __post_init__(self) -> None:
        for name in ("command_s", "command_deg", "measured_s", "measured_deg"):
            object.__setattr__(self, name, own(getattr(self, name)))
        if self.command_s.shape != self.command_deg.shape or self.measured_s.shape != self.measured_deg.shape:
            raise ValueError(f"{self.surface}: times and values differ in number")

    @property
    def duration_s(self) -> float:
        """From the first to the last measurement [s]."""
        return float(self.measured_s[-1] - self.measured_s[0]) if self.measured_s.size else 0.0

    @property
    def period_s(self) -> float:
        """Usual time between two measurements that have a value [s]; NaN if there are fewer than two."""
        steps_s = pace_steps(self.measured_s[np.isfinite(self.measured_deg)])
        return float(np.median(steps_s)) if steps_s.size else float("nan")


def pace_steps(time_s: FloatArray) -> FloatArray:
    """Intervals that tell the pace of a stream [s], from time stamps [s] of shape (n,).

    Those of the warm-up, so that a monitor in flight works with the same numbers as an audit of the whole log; all of
    them if the pace changed after that.

    Examples
    --------
    >>> pace_steps(np.arange(1000) * 0.5).size, pace_steps(np.arange(1000) * 0.01).size
    (20, 100)
    >>> pace_steps(np.concatenate([np.arange(0.0, 10.0, 0.25), np.arange(10.0, 100.0, 0.02)])).size
    4539
    >>> pace_steps(np.zeros(4))
    array([0., 0., 0.])
    """
    last = int(np.searchsorted(time_s, time_s[:1] + WARM_UP_S, side="right").sum()) - 1
    first_s = np.diff(time_s[: 1 + max(1, min(WARM_UP_STEPS, last))])
    if first_s.size == 0:
        return first_s
    every = 1 + (time_s.size - 1) // _STEPS_FOR_PACE
    early_s, usual_s = float(np.median(first_s)), float(np.median(time_s[1::every] - time_s[:-1:every]))
    same = early_s <= SAME_PACE * usual_s and usual_s <= SAME_PACE * early_s
    return first_s if same else np.diff(time_s)


def sent_period_s(time_s: FloatArray) -> float | None:
    """Period of a steady stream of which more than half is lost [s], from stamps of what arrived [s]; None if less is.

    Examples
    --------
    >>> sent_s = np.arange(400) * 0.02
    >>> sent_period_s(sent_s[np.random.default_rng(1).random(400) < 0.25]).__round__(3)
    0.02
    >>> sent_period_s(sent_s)
    """
    steps_s = np.diff(time_s)
    steps_s = steps_s[steps_s <= OUTAGE_S]
    if steps_s.size < _FEWEST_STEPS:
        return None
    shortest_s = float(np.percentile(steps_s, _SHORTEST))
    halves = np.array_split(steps_s, 2)  # a stream whose rate has changed loses nothing
    return shortest_s if all(np.median(half) > _WHOLE * shortest_s for half in halves) else None


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


def cut(log: FlightLog, name: str, surface: Surface) -> Series:
    """Take one surface out of a log, in degrees.

    Parameters
    ----------
    log : FlightLog
        What was recorded.
    name : str
        Name of the surface.
    surface : Surface
        Its channels and calibration.

    Raises
    ------
    NoMeasurement
        If the log does not tell where the surface was, or what was asked of it; the message is the reason.
    """
    command = _channel(log, surface.command.channel, "command")
    if surface.measured is None:
        raise NoMeasurement("the aircraft file names no measured channel for this surface")
    measured = _channel(log, surface.measured.channel, "position")
    if measured.is_constant:
        value = measured.values[np.isfinite(measured.values)][0]
        raise NoMeasurement(f"position channel {measured.name!r} never changes (always {value:g}): not a measurement")
    command_deg = surface.command.to_deg(command.values)
    given = np.isfinite(command_deg)
    if not given.any():
        raise NoMeasurement(f"command channel {command.name!r} holds no command (a pulse of 0 us is none)")
    command_deg = command_deg[given]
    if surface.command_saturation_deg is not None:
        command_deg = np.clip(command_deg, *surface.command_saturation_deg)
    measured_deg = surface.measured.to_deg(measured.values)
    for channel, values_deg in ((command, command_deg), (measured, measured_deg)):
        largest_deg = float(np.nanmax(np.abs(values_deg)))
        if largest_deg > _LARGEST_DEG:
            raise NoMeasurement(
                f"channel {channel.name!r} reaches {largest_deg:.3g} deg: check its unit and calibration"
            )
    if _is_echo(command, measured, surface.command.to_deg(command.values), measured_deg):
        raise NoMeasurement("position equals command in every sample: an echo of the command, not a measurement")
    segment = Series(
        name,
        command.time_s[given],
        command_deg,
        measured.time_s,
        measured_deg,
        surface.command_period_s,
        context=Context(
            *(
                column
                for kind, sources in SURROUNDINGS.items()
                for column in _signal(log, _sources(kind, sources, name, surface))
            )
        ),
        sent_period_s=_sent_period_s(log, command.name, command.time_s[given]),
    )
    return _without_dead_telemetry(segment, measured, log, surface) if surface.alive else segment


def _sent_period_s(log: FlightLog, channel: str, command_s: FloatArray) -> float | None:
    return sent_period_s(command_s[: WARM_UP_STEPS + 1]) if is_streamed(log.format, channel) else None


def is_streamed(log_format: str, channel: str) -> bool:
    """Whether a channel came in messages of its own over a link.

    Examples
    --------
    >>> is_streamed("tlog", "1/1:SERVO_OUTPUT_RAW.servo2_raw"), is_streamed("tlog", "RCOU.C2")
    (True, False)
    """
    name = channel.rpartition(":")[2].partition(".")[0].partition("[")[0]
    return log_format in ("tlog", "live") and name in dialect().layouts


def _sources(kind: str, sources: Mapping[str, float], name: str, surface: Surface) -> Mapping[str, float]:
    """Channels of one surface: a load is its own, and may have its name before it, or be named by its aircraft file."""
    if kind != "servo_load":
        return sources
    return {surface.load: 1.0} if surface.load else {f"{name}_{each}": 1.0 for each in sources} | dict(sources)


def _signal(log: FlightLog, sources: Mapping[str, float]) -> tuple[FloatArray, FloatArray]:
    """Times and values of the first of these channels that holds any; empty if none does."""
    for name, scale in sources.items():
        if name in log.channels:
            channel = log[name]
            good = np.isfinite(channel.values)
            if np.count_nonzero(good) > 1:
                return channel.time_s[good], scale * channel.values[good]
    return np.zeros(0), np.zeros(0)


def _without_dead_telemetry(segment: Series, measured: Channel, log: FlightLog, surface: Surface) -> Series:
    """Take out the rows that only repeat what was said before."""
    siblings = [
        channel.values
        for channel in (log[name] for name in surface.alive if name in log.channels)
        if np.array_equal(channel.time_s, measured.time_s)
    ]
    asked_deg = latest(segment.command_s, segment.command_deg, measured.time_s)
    frozen = frozen_rows(measured.time_s, measured.values, siblings, asked_deg)
    repeated = republished_rows(measured.time_s, measured.values, siblings)
    if frozen.all() or np.count_nonzero(~frozen) < 2:
        raise NoMeasurement("telemetry is frozen: every field repeats to the last bit while the command moves")
    step_s = np.diff(measured.time_s, append=measured.time_s[-1])
    return replace(
        segment,
        measured_deg=np.where(frozen | repeated, np.nan, segment.measured_deg),
        frozen_s=float(step_s[frozen].sum()),
        frozen_to_end=bool(frozen[-1]),
    )


def _channel(log: FlightLog, name: str, kind: str) -> Channel:
    try:
        channel = log[name]
    except MissingChannel as error:
        draft = f"; 'servofd config {log.source}' drafts a file for such logs" if log.is_of_autopilot else ""
        raise NoMeasurement(f"no {kind}: " + str(error).removeprefix(f"{log.label}: ") + draft) from None
    if not np.any(np.isfinite(channel.values)):
        raise NoMeasurement(f"{kind} channel {name!r} holds no value")
    return channel


def _is_echo(command: Channel, measured: Channel, command_deg: FloatArray, measured_deg: FloatArray) -> bool:
    """A position that equals a moving command to the last bit was never measured: no servo is that fast."""
    if command.time_s.shape != measured.time_s.shape or not np.array_equal(command.time_s, measured.time_s):
        return False
    both = np.isfinite(command_deg) & np.isfinite(measured_deg)
    return bool(
        both.any() and np.ptp(command_deg[both]) > 0.0 and np.array_equal(command_deg[both], measured_deg[both])
    )
