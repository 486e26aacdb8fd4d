"""Motion of any log that has it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servofd.axes.autopilot import motion_of_autopilot
from servofd.axes.grid import Series, day_of, grid_rate, present_on
from servofd.axes.motion import Motion
from servofd.core.errors import NoMeasurement

if TYPE_CHECKING:
    from collections.abc import Mapping

    from logparsers.records import Channel, FlightLog
    from servofd.core.types import FloatArray


def motion_of(log: FlightLog, rate_hz: float | None = None, parameters: Mapping[str, float] | None = None) -> Motion:
    """Commands and motion of a log on one grid of time.

    Parameters
    ----------
    log : FlightLog
        Of an autopilot, or a table with the columns of `servofd.axes.read`.
    rate_hz : float, optional
        Of the grid; None: what the log has.
    parameters : mapping of str to float, optional
        SERVOn_... of an autopilot, to assume where the log has none.
    """
    if log.is_of_autopilot:
        return motion_of_autopilot(log, rate_hz, parameters)
    return motion_of_table(log, rate_hz)


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
_RATES = ("p", "q", "r")
_FORCES = ("ax_m_s2", "ay_m_s2", "az_m_s2")
_AIRSPEEDS = (("airspeed_m_s", "sensor"), ("airspeed_est_m_s", "GPS and wind"), ("airspeed_pitot_m_s", "sensor"))


def motion_of_table(log: FlightLog, rate_hz: float | None = None) -> Motion:
    """Motion of a table with plain columns.

    Commands ``ail_cmd_us``, ``ele_cmd_us``, ``rud_cmd_us`` (about trim), ``thr_us``; body rates ``p_rad_s`` ... (or
    ``_deg_s``), specific forces ``ax_m_s2`` ..., attitude ``phi_rad``, ``theta_rad`` (or ``roll_deg``, ``pitch_deg``)
    and an airspeed (``airspeed_m_s``, ``airspeed_est_m_s`` or ``airspeed_pitot_m_s``). What a servo received
    (``*_out_us``) is never read: a fault freezes it.
    """
    commands = {axis: _first(log, names) for axis, names in _COMMANDS.items()}
    given = {axis: channel for axis, channel in commands.items() if channel is not None}
    throttle = _first(log, ("thr_us", "throttle_us", "throttle"))
    rates = [_in_degrees(log, f"{name}_rad_s", f"{name}_deg_s") for name in _RATES]
    forces = [_needed(log, (name,)) for name in _FORCES]
    roll, pitch = _in_degrees(log, "phi_rad", "roll_deg"), _in_degrees(log, "theta_rad", "pitch_deg")
    airspeed, source = _airspeed(log)
    first = next(iter(given.values()), forces[0])
    time_s = first.time_s
    native_hz = _rate(time_s)
    rate_hz = grid_rate(log.label, native_hz, rate_hz)
    grid_s = time_s[0] + np.arange(int((time_s[-1] - time_s[0]) * rate_hz) + 1) / rate_hz

    def means(channel: Channel, *, held: bool = False) -> FloatArray:
        return Series.of(channel).on(grid_s, held=held)

    asked = np.zeros(grid_s.size) if throttle is None else means(throttle)
    if throttle is not None and throttle.name.endswith("_us"):
        asked = (asked - 1000.0) / 1000.0
    every = [*given.values(), *forces, airspeed, *(channel for channel, _ in (*rates, roll, pitch))]
    return Motion(
        name=log.source.name,
        day=day_of(log),
        time_s=grid_s,
        commands_us={axis: means(channel, held=native_hz < rate_hz) for axis, channel in given.items()},
        rates_deg_s=np.array([scale * means(channel) for channel, scale in rates]),
        accelerations_m_s2=np.array([means(channel) for channel in forces]),
        roll_deg=roll[1] * means(roll[0]),
        pitch_deg=pitch[1] * means(pitch[0]),
        airspeed_m_s=means(airspeed),
        throttle=asked,
        present=present_on(grid_s, [Series.of(channel) for channel in every]),
        airspeed_source=source,
        members=_MEMBERS,
    )


def _rate(time_s: FloatArray) -> float:
    step_s = float(np.median(np.diff(time_s)))
    return round(1.0 / step_s, 3)


def _first(log: FlightLog, names: tuple[str, ...]) -> Channel | None:
    for name in names:
        if name in log.channels and np.count_nonzero(np.isfinite(log[name].values)) > 1:
            return log[name]
    return None


def _needed(log: FlightLog, names: tuple[str, ...]) -> Channel:
    found = _first(log, names)
    if found is None:
        raise NoMeasurement(
            f"{log.label}: no {names[0]}: motion needs body rates, specific forces, attitude and an airspeed beside "
            "the commands"
        )
    return found


def _in_degrees(log: FlightLog, radians: str, degrees: str) -> tuple[Channel, float]:
    channel = _needed(log, (degrees, radians))
    return channel, 1.0 if channel.name == degrees else float(np.degrees(1.0))


def _airspeed(log: FlightLog) -> tuple[Channel, str]:
    """First airspeed that measures something: a pitot that reads 0 does not."""
    for name, source in _AIRSPEEDS:
        channel = _first(log, (name,))
        if channel is not None and float(np.nanmedian(channel.values)) > 1.0:
            return channel, source
    raise NoMeasurement(
        f"{log.label}: no airspeed that measures anything (airspeed_m_s, airspeed_est_m_s or airspeed_pitot_m_s): the "
        "effect of a surface grows with its square; log a sensor, or GPS velocity and the autopilot's wind"
    )
