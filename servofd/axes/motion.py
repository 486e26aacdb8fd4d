"""Motion of an aircraft without servo feedback, from any log: which channel is which, all on one grid of time."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Self

import numpy as np

from logparsers.records import FlightLog
from servofd.aircraft.outputs import WITHOUT_SURFACES, LoggedOutput, named_outputs, outputs_of, pulse_channel
from servofd.aircraft.series import FLIES_M_S, signal_of
from servofd.core.errors import NoMeasurement
from servofd.core.types import BoolArray, FloatArray

Choice = tuple[Sequence[str], float]
"""Channels that belong together, and the factor to the unit that is wanted."""
Asked = tuple[dict[str, FloatArray], FloatArray, BoolArray]
"""Commands of the axes [us], throttle, and where motors lift the aircraft, on a grid of time."""


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """What was asked of an aircraft and how it moved, in body axes forward, right, down.

    `name`: of the flight, for messages. `day`: on which it was flown; flights of one day share their trim, air and
    payload. `time_s` (shape (n,)): uniform [s]. `commands_us` (shape (n,)): for ``"roll"``, ``"pitch"``, ``"yaw"`` what
    was asked of the axis, as pulse width about trim [us]; never what a servo received or did. `rates_deg_s` (shape (3,
    n)): body rates [deg/s]. `accelerations_m_s2` (shape (3, n)): specific force [m/s2]. `roll_deg`, `pitch_deg` (shape
    (n,)): attitude [deg]. `airspeed_m_s` (shape (n,)): from a sensor, or from ground speed and wind [m/s]. `throttle`
    (shape (n,)): what was asked of the engine, 0 to 1. `present` (shape (n,)): false where a channel has a gap.
    `airspeed_source`: in words. `members`: surfaces that serve each axis. `parameters`: SERVOn_... of the outputs that
    do. `lifted_share`: share of the log in which motors lifted a VTOL aircraft, which is not `present`.
    """

    name: str
    day: str
    time_s: FloatArray
    commands_us: Mapping[str, FloatArray]
    rates_deg_s: FloatArray
    accelerations_m_s2: FloatArray
    roll_deg: FloatArray
    pitch_deg: FloatArray
    airspeed_m_s: FloatArray
    throttle: FloatArray
    present: BoolArray
    airspeed_source: str = "sensor"
    members: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    parameters: Mapping[str, float] = field(default_factory=dict)
    lifted_share: float = 0.0

    @property
    def asked(self) -> frozenset[str]:
        """What is commanded: axes, and the throttle."""
        return frozenset((*self.commands_us, "throttle"))

    @property
    def rate_hz(self) -> float:
        """Samples in a second."""
        return (self.time_s.size - 1) / float(self.time_s[-1] - self.time_s[0])

    def within(self, spans_s: Sequence[tuple[float, float]]) -> Motion:
        """The same flight, present only in some parts."""
        inside = np.zeros(self.time_s.size, dtype=bool)
        for start_s, end_s in spans_s:
            inside |= (self.time_s >= start_s) & (self.time_s <= end_s)
        return replace(self, present=self.present & inside)

    def until(self, end_s: float) -> Motion:
        """The part before a time."""
        last = int(np.searchsorted(self.time_s, end_s))
        values = ((one.name, getattr(self, one.name)) for one in fields(self))
        cut: dict[str, Any] = {name: value[..., :last] for name, value in values if isinstance(value, np.ndarray)}
        return replace(self, commands_us={axis: us[:last] for axis, us in self.commands_us.items()}, **cut)


LARGEST_GAP_S = 1.0
"""Channels of an autopilot come every 0.25 s at the slowest; nothing is guessed across more than four of them."""


_SLOWER = 1.5
"""Times slower than the flights of the calibration that a log may be."""
_SLOWEST_HZ = 10.0
"""What comes more seldom is judged on a grid as fast, that of ALFA, whose commands come at 3 Hz: a command holds until
the next, and the filters of the axes need some samples in a period of their corner."""


def grid_rate(label: str, native_hz: float, rate_hz: float | None) -> float:
    """Rate of the grid for commands and motion of some rate.

    Those that come much more seldom than those of the calibration are refused: they are late and coarse.
    """
    if rate_hz is None:
        return max(native_hz, _SLOWEST_HZ)
    if rate_hz > max(_SLOWER * native_hz, _SLOWEST_HZ):
        raise NoMeasurement(
            f"{label}: commands and motion come at {native_hz:.3g} Hz, those of the calibration at {rate_hz:.3g} Hz; "
            "calibrate on logs of the same kind, or log faster"
        )
    return rate_hz


@dataclass(frozen=True, slots=True)
class Series:
    """Finite values of a channel at their own times, shape (n,) each."""

    time_s: FloatArray
    values: FloatArray

    @property
    def rate_hz(self) -> float:
        """Typical rate of samples."""
        return 1.0 / float(np.median(np.diff(self.time_s)))

    def within(self, begin_s: float, end_s: float) -> Self:
        """What it holds of a part of the log."""
        at = (self.time_s >= begin_s) & (self.time_s <= end_s)
        return replace(self, time_s=self.time_s[at], values=self.values[at])

    def on(self, grid_s: FloatArray, *, held: bool = False) -> FloatArray:
        """Means over the cells of a grid."""
        return cell_means(grid_s, self.time_s, self.values, held=held)


def day_of(log: FlightLog) -> str:
    """Day of a flight: what the log says, else a date in its name, else the name: a day of its own."""
    if log.start_utc is not None:
        return log.start_utc.date().isoformat()
    dated = re.search(r"(20\d\d)[-_]?(\d\d)[-_]?(\d\d)", log.source.name)
    return "-".join(dated.groups()) if dated else log.source.name


def present_on(grid_s: FloatArray, channels: Sequence[Series]) -> BoolArray:
    """Where no channel has a gap."""
    present = np.ones(grid_s.size, dtype=bool)
    for channel in channels:
        time_s = channel.time_s
        after = np.clip(np.searchsorted(time_s, grid_s), 1, time_s.size - 1)
        gap_s = time_s[after] - time_s[after - 1]
        present &= (gap_s <= LARGEST_GAP_S) & (grid_s >= time_s[0]) & (grid_s <= time_s[-1])
    return present


def cell_means(grid_s: FloatArray, time_s: FloatArray, values: FloatArray, *, held: bool = False) -> FloatArray:
    """Mean of a channel over the cell that ends at each point of a uniform grid.

    A faster channel is averaged, which keeps what it has above half the grid's rate from folding down; of a slower
    one the straight line between samples is taken, or what was held.
    """
    step_s = float(grid_s[1] - grid_s[0])
    edges = np.concatenate(([grid_s[0] - step_s], grid_s))
    if time_s.size < 2:
        return np.full(grid_s.size, values[0])
    spans = np.diff(time_s)
    pieces = (values[:-1] if held else (values[:-1] + values[1:]) / 2.0) * spans
    areas = np.concatenate(([0.0], np.cumsum(pieces)))
    inside = np.clip(edges, time_s[0], time_s[-1])
    place = np.clip(np.searchsorted(time_s, inside, side="right") - 1, 0, time_s.size - 2)
    ahead = inside - time_s[place]
    slope = 0.0 if held else (values[place + 1] - values[place]) / spans[place]
    area = areas[place] + values[place] * ahead + slope * ahead**2 / 2.0
    area += np.where(edges < time_s[0], values[0], values[-1]) * (edges - inside)
    return np.diff(area) / step_s


SHARES: Mapping[int, tuple[tuple[str, float], ...]] = {
    4: (("roll", 1.0),),
    19: (("pitch", 1.0),),
    21: (("yaw", 1.0),),
    24: (("roll", -1.0),),
    25: (("roll", 1.0),),
    77: (("pitch", 1.0), ("roll", -1.0)),
    78: (("pitch", 1.0), ("roll", 1.0)),
    79: (("pitch", 1.0), ("yaw", -1.0)),
    80: (("pitch", 1.0), ("yaw", 1.0)),
}
"""SERVOn_FUNCTION to what a surface does, with the signs of ArduPlane's mixers (left is the difference)."""

_THROTTLES = frozenset({70, 73, 74})
LIFT_MOTORS = frozenset({*range(33, 41), *range(82, 86), 160})
AXIS_OF = {"roll": "roll", "pitch": "pitch", "yaw": "side"}
"""Axis that each command turns."""


@dataclass(frozen=True, slots=True)
class Airframe:
    """Outputs by what they serve.

    `commands`: for ``"roll"``, ``"pitch"``, ``"yaw"`` each output and what it adds; none of a multirotor. `throttles`,
    `lift_motors`: engines that pull forward, and motors that lift. `members`: surfaces of each axis; one that serves
    two axes stands in both.
    """

    commands: Mapping[str, tuple[tuple[LoggedOutput, float], ...]]
    throttles: tuple[LoggedOutput, ...]
    lift_motors: tuple[LoggedOutput, ...]
    members: Mapping[str, tuple[str, ...]]


def airframe_of(outputs: Mapping[int, LoggedOutput]) -> Airframe:
    """Sort outputs by what they serve."""
    served: dict[str, list[tuple[LoggedOutput, float]]] = {}
    for output in outputs.values():
        for axis, sign in SHARES.get(output.function or 0, ()):
            served.setdefault(axis, []).append((output, sign))
    surfaces = sorted({output.number for parts in served.values() for output, _ in parts})
    names = named_outputs(outputs, surfaces)
    return Airframe(
        commands={axis: tuple((output, sign / len(parts)) for output, sign in parts) for axis, parts in served.items()},
        throttles=tuple(output for output in outputs.values() if output.function in _THROTTLES),
        lift_motors=tuple(output for output in outputs.values() if output.function in LIFT_MOTORS),
        members={AXIS_OF[axis]: tuple(names[output.number] for output, _ in parts) for axis, parts in served.items()}
        | {"thrust": ("engine",)},
    )


_FASTEST_HZ = 25.0
"""Fastest grid [Hz]: axes answer more slowly."""
_OF_AN_OUTPUT = re.compile(r"SERVO(\d+)_(FUNCTION|TRIM|MIN|MAX|REVERSED)")
_IDLE_SHARE = 0.05
"""Share of the throttle below which a motor does not lift."""
_STANDS_M_S = 1.0
"""Ground speed below which an aircraft that is no copter stands on the ground, as GPS measures it [m/s]."""
GPS = "GPS and wind"
"""Source of an airspeed that is there though the aircraft stands still."""
_MEASURES_M_S = 1.0
"""What an airspeed that measures something exceeds at some time [m/s]."""
_AS_LONG = 0.8
"""Share of the time in the air by the best witness that another must show: a dead pitot reads noise, and one that gets
blocked ends the flight."""
DEG = float(np.degrees(1.0))
_RATES: tuple[Choice, ...] = (
    *(([f"{imu}.Gyr{axis}" for axis in "XYZ"], DEG) for imu in ("IMU[0]", "IMU")),
    *(([f"{imu}.{axis}gyro" for axis in "xyz"], 1e-3 * DEG) for imu in ("RAW_IMU", "SCALED_IMU2")),
)
"""Channels of the body rates, and the factor to deg/s."""
_FORCES: tuple[Choice, ...] = (
    *(([f"{imu}.Acc{axis}" for axis in "XYZ"], 1.0) for imu in ("IMU[0]", "IMU")),
    *(([f"{imu}.{axis}acc" for axis in "xyz"], 9.80665e-3) for imu in ("RAW_IMU", "SCALED_IMU2")),
)
"""Channels of the specific forces, and the factor to m/s2."""
_ATTITUDES: tuple[Choice, ...] = ((("ATT.Roll", "ATT.Pitch"), 1.0), (("ATTITUDE.roll", "ATTITUDE.pitch"), DEG))
_WINDS = (
    ("XKF1[0].VN", "XKF1[0].VE", "XKF1[0].VD", "XKF2[0].VWN", "XKF2[0].VWE"),
    ("NKF1[0].VN", "NKF1[0].VE", "NKF1[0].VD", "NKF2[0].VWN", "NKF2[0].VWE"),
)


def motion_of_autopilot(
    log: FlightLog, rate_hz: float | None = None, parameters: Mapping[str, float] | None = None
) -> Motion:
    """Motion of an ArduPilot log, from flash or telemetry."""
    settings = {name: value for name, value in log.parameters.items() if _OF_AN_OUTPUT.fullmatch(name)}
    if not any(name.endswith("_FUNCTION") for name in settings):
        if log.vehicle in WITHOUT_SURFACES:
            raise NoMeasurement(_no_surfaces(log, airframe_of({})))
        settings = dict(parameters or {})
    outputs = outputs_of(settings)
    airframe = airframe_of(outputs)
    if not airframe.commands:
        raise NoMeasurement(_no_surfaces(log, airframe))
    pulses = {number: series_of(log, pulse_channel(log.channels, number)) for number in outputs}
    needed = {output.number for parts in airframe.commands.values() for output, _ in parts}
    silent = sorted(number for number in needed if pulses[number] is None)
    if silent:
        raise NoMeasurement(f"{log.label}: no commands of output {silent[0]} (RCOU or SERVO_OUTPUT_RAW)")
    rates, forces, attitude = (
        chosen(log, choices, f"no {what}: {ALL_NEEDED}")
        for choices, what in (
            (_RATES, "body rates (IMU)"),
            (_FORCES, "specific forces (IMU)"),
            (_ATTITUDES, "attitude (ATT)"),
        )
    )
    served = needed | {output.number for output in (*airframe.throttles, *airframe.lift_motors)}

    def asked(grid_s: FloatArray) -> Asked:
        def of_output(output: LoggedOutput) -> FloatArray:
            series = pulses.get(output.number)
            return np.zeros(grid_s.size) if series is None else series.on(grid_s, held=True)

        commands = {
            axis: np.sum([weight * one.sign * (of_output(one) - one.trim_us) for one, weight in parts], axis=0)
            for axis, parts in airframe.commands.items()
        }
        pulling = [_share(output, of_output(output)) for output in airframe.throttles]
        throttle = np.mean(pulling, axis=0) if pulling else np.zeros(grid_s.size)
        lifting = np.zeros(grid_s.size, dtype=bool)  # of a VTOL aircraft, which surfaces do not fly alone then
        for output in airframe.lift_motors:
            lifting |= _share(output, of_output(output)) > _IDLE_SHARE
        return commands, throttle, lifting

    return on_one_grid(
        log,
        rate_hz,
        asked,
        [series for number in sorted(needed) if (series := pulses[number]) is not None],
        rates,
        forces,
        attitude,
        airspeed_of(log),
        members=airframe.members,
        parameters={
            name: value
            for name, value in settings.items()
            if (of := _OF_AN_OUTPUT.fullmatch(name)) and int(of[1]) in served
        },
    )


def on_one_grid(
    log: FlightLog,
    rate_hz: float | None,
    asked: Callable[[FloatArray], Asked],
    commands: Sequence[Series],
    rates: Sequence[Series],
    forces: Sequence[Series],
    attitude: Sequence[Series],
    airspeed: tuple[Series, str],
    *,
    members: Mapping[str, tuple[str, ...]],
    parameters: Mapping[str, float] | None = None,
) -> Motion:
    """Motion of an autopilot's log from its channels, where all of them are there.

    `commands`: what was sent to each output or axis. `rates` [deg/s], `forces` [m/s2], bank and pitch [deg], airspeed
    [m/s] and its source.
    """
    native_hz = min(_FASTEST_HZ, *(round(one.rate_hz, 3) for one in (*commands[:1], rates[0], forces[0])))
    rate_hz = grid_rate(log.label, native_hz, rate_hz)
    every = [*commands, *rates, *forces, *attitude, airspeed[0]]
    start_s, end_s = max(one.time_s[0] for one in every), min(one.time_s[-1] for one in every)
    if end_s - start_s < LARGEST_GAP_S:
        raise NoMeasurement(f"{log.label}: commands and motion share no time")
    grid_s = start_s + np.arange(1, int((end_s - start_s) * rate_hz) + 1) / rate_hz
    commands_us, throttle, lifting = asked(grid_s)
    return Motion(
        name=log.source.name,
        day=day_of(log),
        time_s=grid_s,
        commands_us=commands_us,
        rates_deg_s=np.array([one.on(grid_s) for one in rates]),
        accelerations_m_s2=np.array([one.on(grid_s) for one in forces]),
        roll_deg=attitude[0].on(grid_s),
        pitch_deg=attitude[1].on(grid_s),
        airspeed_m_s=airspeed[0].on(grid_s),
        throttle=throttle,
        present=present_on(grid_s, every) & ~lifting,
        airspeed_source=airspeed[1],
        members=members,
        parameters=parameters or {},
        lifted_share=float(lifting.mean()),
    )


def _no_surfaces(log: FlightLog, airframe: Airframe) -> str:
    kind = log.vehicle or ("multirotor" if airframe.lift_motors else "")
    if airframe.lift_motors or kind in WITHOUT_SURFACES:
        does = WITHOUT_SURFACES.get(kind, "turn motors")
        return f"{log.label}: a {kind}: no control surfaces to judge; its outputs {does}"
    return (
        f"{log.label}: no output with the function of a control surface; SERVOn_FUNCTION must be among the log's "
        "parameters (a log that begins at boot has them)"
    )


def series_of(log: FlightLog, name: str, scale: float = 1.0) -> Series | None:
    """Finite values of a channel, in other units; None if there are fewer than two."""
    time_s, values = signal_of(log, {name: scale})
    return Series(time_s, values) if time_s.size else None


ALL_NEEDED = "motion cannot be judged without"


def chosen(log: FlightLog, choices: Iterable[Choice], lacking: str = "") -> list[Series]:
    """Channels of the first choice that a log has all of.

    If it has none: nothing, or `NoMeasurement` that says what is `lacking`.
    """
    for names, scale in choices:
        found = [one for name in names if (one := series_of(log, name, scale)) is not None]
        if len(found) == len(names):
            return found
    if lacking:
        raise NoMeasurement(f"{log.label}: {lacking}")
    return []


def airspeed_of(log: FlightLog) -> tuple[Series, str]:
    """A sensor that measures something; else ground speed less wind; else the autopilot's own estimate."""
    witnesses = [(series_of(log, name), "sensor") for name in ("ARSP[0].Airspeed", "ARSP.Airspeed")]
    witnesses += [(through_the_wind(log, names), GPS) for names in _WINDS]
    witnesses += [(series_of(log, name), "the autopilot's estimate") for name in ("CTUN.As", "VFR_HUD.airspeed")]
    return airspeed_among(
        log,
        witnesses,
        "no airspeed that measures anything: the effect of a surface grows with its square; log a sensor (ARSP), or "
        "the estimator's velocity and wind (XKF1, XKF2)",
    )


def airspeed_among(log: FlightLog, witnesses: Sequence[tuple[Series | None, str]], lacking: str) -> tuple[Series, str]:
    """First airspeed that shows the aircraft in the air for as long as the others do, nearly.

    Raises `NoMeasurement`, which says what is `lacking`, if none measures.
    """
    there = [(one, source) for one, source in witnesses if one is not None]
    known = [each for each in there if each[1] == GPS or float(np.max(each[0].values)) > _MEASURES_M_S]
    if not known:
        raise NoMeasurement(f"{log.label}: {lacking}")
    flown_s = [float(np.sum(np.diff(one.time_s)[one.values[1:] > FLIES_M_S])) for one, _ in known]
    return next(one for one, at in zip(known, flown_s, strict=True) if at >= _AS_LONG * max(flown_s))


def at_times_of_first(parts: Sequence[Series]) -> list[FloatArray]:
    """Values of channels whose damaged samples were left out, each of its own, at the times of the first."""
    return [np.interp(parts[0].time_s, one.time_s, one.values) for one in parts]


def through_the_wind(log: FlightLog, names: Sequence[str]) -> Series | None:
    """Airspeed [m/s] from channels of velocity north, east and down and of wind north and east; None if one lacks."""
    parts = chosen(log, [(names, 1.0)])
    if not parts:
        return None
    north, east, down, wind_north, wind_east = at_times_of_first(parts)
    through_m_s = np.sqrt((north - wind_north) ** 2 + (east - wind_east) ** 2 + down**2)
    stands = np.hypot(north, east) < _STANDS_M_S  # the estimator keeps its wind on the ground
    return Series(parts[0].time_s, np.where(stands, 0.0, through_m_s))


def _share(output: LoggedOutput, pulses_us: FloatArray) -> FloatArray:
    share = (pulses_us - output.min_us) / max(output.max_us - output.min_us, 1.0)
    return np.clip(1.0 - share if output.reversed else share, 0.0, 1.0)


_COMMANDS = {
    "roll": ("ail_cmd_us", "aileron_cmd_us", "roll_cmd_us"),
    "pitch": ("ele_cmd_us", "elevator_cmd_us", "pitch_cmd_us"),
    "yaw": ("rud_cmd_us", "rudder_cmd_us", "yaw_cmd_us"),
}
_MEMBERS = {
    "roll": ("aileron_left", "aileron_right"),
    "pitch": ("elevator",),
    "side": ("rudder",),
    "thrust": ("engine",),
}
_AIRSPEEDS = (("airspeed_m_s", "sensor"), ("airspeed_est_m_s", GPS), ("airspeed_pitot_m_s", "sensor"))


def motion_of_table(log: FlightLog, rate_hz: float | None = None) -> Motion:
    """Motion of a table with plain columns.

    Commands ``ail_cmd_us``, ``ele_cmd_us``, ``rud_cmd_us`` (about trim), ``thr_us``; body rates ``p_rad_s`` ... (or
    ``_deg_s``), specific forces ``ax_m_s2`` ..., attitude ``phi_rad``, ``theta_rad`` (or ``roll_deg``, ``pitch_deg``)
    and an airspeed (``airspeed_m_s``, ``airspeed_est_m_s`` or ``airspeed_pitot_m_s``). What a servo received
    (``*_out_us``) is never read: a fault freezes it.
    """
    commands = {
        axis: one for axis, names in _COMMANDS.items() for one in chosen(log, [([name], 1.0) for name in names])
    }
    throttle = series_of(log, "throttle")
    for pulse in chosen(log, [(["thr_us"], 1.0), (["throttle_us"], 1.0)]):
        throttle = Series(pulse.time_s, (pulse.values - 1000.0) / 1000.0)
    rates = [_column(log, f"{name}_deg_s", f"{name}_rad_s") for name in "pqr"]
    forces = [_column(log, f"a{name}_m_s2") for name in "xyz"]
    native_hz = forces[0].rate_hz

    def asked(grid_s: FloatArray) -> Asked:
        held = native_hz < (1.0 - _SAME_RATE) / float(grid_s[1] - grid_s[0])
        pulled = np.zeros(grid_s.size) if throttle is None else throttle.on(grid_s)
        lifted = np.zeros(grid_s.size, dtype=bool)
        return {axis: one.on(grid_s, held=held) for axis, one in commands.items()}, pulled, lifted

    attitude = (_column(log, "roll_deg", "phi_rad"), _column(log, "pitch_deg", "theta_rad"))
    airspeed = _airspeed_of_table(log)
    return on_one_grid(log, rate_hz, asked, [*commands.values()], rates, forces, attitude, airspeed, members=_MEMBERS)


_SAME_RATE = 0.01
"""Rates that differ by less are the same."""


def _column(log: FlightLog, name: str, radians: str = "") -> Series:
    """A column, in degrees if there is one in radians alone."""
    needed = "motion needs body rates, specific forces, attitude and an airspeed beside the commands"
    return chosen(log, [([name], 1.0), ([radians], DEG)], f"no {name}: {needed}")[0]


def _airspeed_of_table(log: FlightLog) -> tuple[Series, str]:
    """First airspeed that measures something: a pitot that reads 0 does not."""
    for name, source in _AIRSPEEDS:
        series = series_of(log, name)
        if series is not None and float(np.median(series.values)) > _MEASURES_M_S:
            return series, source
    raise NoMeasurement(
        f"{log.label}: no airspeed that measures anything (airspeed_m_s, airspeed_est_m_s or airspeed_pitot_m_s): the "
        "effect of a surface grows with its square; log a sensor, or GPS velocity and the autopilot's wind"
    )
