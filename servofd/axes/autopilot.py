"""Motion from the logs of autopilots: which channel is which, on one grid of time."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np

from servofd.aircraft.outputs import outputs_of, pulse_channel
from servofd.axes.grid import LARGEST_GAP_S, Series, day_of, grid_rate, present_on
from servofd.axes.mixers import airframe_of
from servofd.axes.motion import Motion
from servofd.core.errors import NoMeasurement

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from logparsers.records import FlightLog
    from servofd.aircraft.outputs import LoggedOutput
    from servofd.axes.mixers import Airframe
    from servofd.core.types import BoolArray, FloatArray

_FASTEST_HZ = 25.0
_OF_AN_OUTPUT = re.compile(r"SERVO\d+_(FUNCTION|TRIM|MIN|MAX|REVERSED)")
_IDLE_SHARE = 0.05
_ON_MOTORS = ("multirotor", "helicopter")
_MEASURES_M_S = 1.0
_RATES = (
    ("IMU[0].Gyr{}", "IMU.Gyr{}", "XYZ", np.degrees(1.0)),
    ("RAW_IMU.{}gyro", "SCALED_IMU2.{}gyro", "xyz", 1e-3 * np.degrees(1.0)),
)
_FORCES = (
    ("IMU[0].Acc{}", "IMU.Acc{}", "XYZ", 1.0),
    ("RAW_IMU.{}acc", "SCALED_IMU2.{}acc", "xyz", 9.80665e-3),
)
_ATTITUDES = (("ATT.Roll", "ATT.Pitch", 1.0), ("ATTITUDE.roll", "ATTITUDE.pitch", float(np.degrees(1.0))))
_WINDS = (
    ("XKF1[0].VN", "XKF1[0].VE", "XKF1[0].VD", "XKF2[0].VWN", "XKF2[0].VWE"),
    ("NKF1[0].VN", "NKF1[0].VE", "NKF1[0].VD", "NKF2[0].VWN", "NKF2[0].VWE"),
)


def motion_of_autopilot(
    log: FlightLog, rate_hz: float | None = None, parameters: Mapping[str, float] | None = None
) -> Motion:
    """Motion of an ArduPilot log, from flash or telemetry.

    Parameters
    ----------
    log : FlightLog
        With ``SERVOn_FUNCTION`` among its parameters, outputs, gyros, accelerometers, attitude and an airspeed.
    rate_hz : float, optional
        Of the grid; None: that of the outputs, from 10 to 25 Hz.
    parameters : mapping of str to float, optional
        SERVOn_... to assume where the log has none.
    """
    settings = {name: value for name, value in log.parameters.items() if _OF_AN_OUTPUT.fullmatch(name)}
    if not any(name.endswith("_FUNCTION") for name in settings):
        if log.vehicle in _ON_MOTORS:
            raise NoMeasurement(_no_surfaces(log, airframe_of({})))
        settings = dict(parameters or {})
    outputs = outputs_of(settings)
    airframe = airframe_of(outputs)
    if not airframe.has_surfaces:
        raise NoMeasurement(_no_surfaces(log, airframe))
    pulses = {number: _series(log, pulse_channel(log.channels, number)) for number in outputs}
    needed = {share.output.number for parts in airframe.commands.values() for share in parts}
    silent = sorted(number for number in needed if pulses[number] is None)
    if silent:
        raise NoMeasurement(f"{log.label}: no commands of output {silent[0]} (RCOU or SERVO_OUTPUT_RAW)")
    rates, forces = _triple(log, _RATES, "body rates (IMU)"), _triple(log, _FORCES, "specific forces (IMU)")
    roll, pitch = _attitude(log)
    airspeed, source = _airspeed(log)
    first = next(series for number in needed if (series := pulses[number]) is not None)
    native_hz = min(_FASTEST_HZ, *(one.rate_hz for one in (first, rates[0], forces[0])))
    rate_hz = grid_rate(log.label, native_hz, rate_hz)
    start_s = max(one.time_s[0] for one in (first, rates[0], forces[0], roll, airspeed))
    end_s = min(one.time_s[-1] for one in (first, rates[0], forces[0], roll, airspeed))
    if end_s - start_s < LARGEST_GAP_S:
        raise NoMeasurement(f"{log.label}: commands and motion share no time")
    grid_s = start_s + np.arange(1, int((end_s - start_s) * rate_hz) + 1) / rate_hz

    def of_output(output: LoggedOutput) -> FloatArray:
        series = pulses.get(output.number)
        return np.zeros(grid_s.size) if series is None else series.on(grid_s, held=True)

    commands = {}
    for axis, parts in airframe.commands.items():
        asked = [part.weight * part.output.sign * (of_output(part.output) - part.output.trim_us) for part in parts]
        commands[axis] = np.sum(asked, axis=0)
    served = needed | {output.number for output in (*airframe.throttles, *airframe.lift_motors)}
    lifting = _lifting(airframe, of_output, grid_s)
    every = [first, *rates, *forces, roll, pitch, airspeed]
    return Motion(
        name=log.source.name,
        day=day_of(log),
        time_s=grid_s,
        commands_us=commands,
        rates_deg_s=np.array([one.on(grid_s) for one in rates]),
        accelerations_m_s2=np.array([one.on(grid_s) for one in forces]),
        roll_deg=roll.on(grid_s),
        pitch_deg=pitch.on(grid_s),
        airspeed_m_s=airspeed.on(grid_s),
        throttle=_throttle(airframe, of_output, grid_s),
        present=present_on(grid_s, every) & ~lifting,
        airspeed_source=source,
        members=airframe.members,
        parameters={name: value for name, value in settings.items() if _number(name) in served},
        lifted_share=float(lifting.mean()),
    )


def _number(parameter: str) -> int:
    return int(parameter.removeprefix("SERVO").partition("_")[0])


def _no_surfaces(log: FlightLog, airframe: Airframe) -> str:
    if airframe.lift_motors or log.vehicle in _ON_MOTORS:
        kind = log.vehicle or "multirotor"
        return f"{log.label}: a {kind}: no control surfaces to judge; its outputs drive motors"
    return (
        f"{log.label}: no output with the function of a control surface; SERVOn_FUNCTION must be among the log's "
        "parameters (a log that begins at boot has them)"
    )


def _series(log: FlightLog, name: str, scale: float = 1.0) -> Series | None:
    if not name or name not in log.channels:
        return None
    channel = log[name]
    good = np.isfinite(channel.values)
    return Series(channel.time_s[good], scale * channel.values[good]) if np.count_nonzero(good) > 1 else None


def _triple(log: FlightLog, choices: tuple[tuple[str, str, str, float], ...], what: str) -> list[Series]:
    for *names, letters, scale in choices:
        for name in names:
            found = [_series(log, str(name).format(letter), float(scale)) for letter in str(letters)]
            if all(one is not None for one in found):
                return [one for one in found if one is not None]
    raise NoMeasurement(f"{log.label}: no {what}: motion cannot be judged without")


def _attitude(log: FlightLog) -> tuple[Series, Series]:
    for roll, pitch, scale in _ATTITUDES:
        one, other = _series(log, roll, scale), _series(log, pitch, scale)
        if one is not None and other is not None:
            return one, other
    raise NoMeasurement(f"{log.label}: no attitude (ATT): motion cannot be judged without")


def _airspeed(log: FlightLog) -> tuple[Series, str]:
    """A sensor that measures something; else ground speed less wind; else the autopilot's own estimate."""
    for name in ("ARSP[0].Airspeed", "ARSP.Airspeed"):
        sensor = _series(log, name)
        if sensor is not None and float(np.max(sensor.values)) > _MEASURES_M_S:
            return sensor, "sensor"
    for north, east, down, wind_north, wind_east in _WINDS:
        parts = [_series(log, name) for name in (north, east, down, wind_north, wind_east)]
        vn, ve, vd, wn, we = parts
        if vn is not None and ve is not None and vd is not None and wn is not None and we is not None:
            wind = [np.interp(vn.time_s, one.time_s, one.values) for one in (wn, we)]
            speed = np.sqrt((vn.values - wind[0]) ** 2 + (ve.values - wind[1]) ** 2 + vd.values**2)
            return Series(vn.time_s, speed), "GPS and wind"
    for name in ("CTUN.As", "VFR_HUD.airspeed"):
        estimate = _series(log, name)
        if estimate is not None and float(np.max(estimate.values)) > _MEASURES_M_S:
            return estimate, "the autopilot's estimate"
    raise NoMeasurement(
        f"{log.label}: no airspeed that measures anything: the effect of a surface grows with its square; log a sensor "
        "(ARSP), or the estimator's velocity and wind (XKF1, XKF2)"
    )


def _throttle(airframe: Airframe, of_output: Callable[[LoggedOutput], FloatArray], grid_s: FloatArray) -> FloatArray:
    shares = [_share(output, of_output(output)) for output in airframe.throttles]
    return np.mean(shares, axis=0) if shares else np.zeros(grid_s.size)


def _share(output: LoggedOutput, pulses_us: FloatArray) -> FloatArray:
    share = (pulses_us - output.min_us) / max(output.max_us - output.min_us, 1.0)
    return np.clip(1.0 - share if output.reversed else share, 0.0, 1.0)


def _lifting(airframe: Airframe, of_output: Callable[[LoggedOutput], FloatArray], grid_s: FloatArray) -> BoolArray:
    """Where a motor of a VTOL aircraft lifts: surfaces do not fly it alone then."""
    lifting = np.zeros(grid_s.size, dtype=bool)
    for output in airframe.lift_motors:
        lifting |= _share(output, of_output(output)) > _IDLE_SHARE
    return lifting
