"""Motion of a PX4 log: which surface serves which axis, as its control allocation says, and how the aircraft moved."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servofd.aircraft.outputs import PX4_TYPES
from servofd.axes.motion import LARGEST_GAP_S, Motion, Series, day_of, grid_rate, present_on
from servofd.core.errors import NoMeasurement

if TYPE_CHECKING:
    from logparsers.records import FlightLog
    from servofd.core.types import FloatArray

_MOST_SERVOS = 8
"""Surfaces that PX4's control allocation knows at most (CA_SV_CSk)."""
_HALF_TRAVEL_US = 500.0
"""What 1 of a control is on an output of 1000 to 2000 us."""
_AXES = {"roll": "R", "pitch": "P", "yaw": "Y"}
_MEMBERS = {"roll": "roll", "pitch": "pitch", "yaw": "side"}
_CONTROLS = {"roll": 0, "pitch": 1, "yaw": 2}
_THROTTLE_CONTROL = 3
"""Place of the throttle among the controls of actuator_controls."""
_MOVES = {"aileron": ("roll",), "elevator": ("pitch",), "rudder": ("yaw",), "elevon": ("roll", "pitch")}
_MOVES |= {"vtail": ("pitch", "yaw")}
"""Axes of a surface where no CA_SV_CSk_TRQ_* says them (ActuatorEffectivenessControlSurfaces)."""
_AGAINST = {"roll": "left", "yaw": "right"}
"""Side whose surface turns the aircraft the other way."""
_FORWARD, _FASTEST_HZ = 4, 25.0
"""vehicle_vtol_state of a VTOL that flies as a fixed wing."""


def _shares(name: str) -> dict[str, float]:
    """What a surface of this name does to each axis."""
    word, _, side = name.partition("_")
    return {axis: -1.0 if _AGAINST.get(axis) == side else 1.0 for axis in _MOVES.get(word, ())}


def motion_of_px4(log: FlightLog, rate_hz: float | None = None) -> Motion:
    """Motion of a ULog; of a VTOL while it flies forward."""
    commands, members = _commands(log)
    rates = _vector(log, ("vehicle_angular_velocity[0].xyz", "sensor_combined[0].gyro_rad"), float(np.degrees(1.0)))
    forces = _vector(log, ("vehicle_acceleration[0].xyz", "sensor_combined[0].accelerometer_m_s2"), 1.0)
    q = _vector(log, ("vehicle_attitude[0].q",), 1.0, 4)
    airspeed, source = _airspeed(log)
    first = next(iter(commands.values()))
    native_hz = min(_FASTEST_HZ, *(one.rate_hz for one in (first, rates[0], forces[0])))
    rate_hz = grid_rate(log.label, native_hz, rate_hz)
    every = [*commands.values(), *rates, *forces, q[0], airspeed]
    start_s, end_s = max(one.time_s[0] for one in every), min(one.time_s[-1] for one in every)
    if end_s - start_s < LARGEST_GAP_S:
        raise NoMeasurement(f"{log.label}: commands and motion share no time")
    grid_s = start_s + np.arange(1, int((end_s - start_s) * rate_hz) + 1) / rate_hz
    roll_deg, pitch_deg = _attitude([np.interp(grid_s, one.time_s, one.values) for one in q])
    lifted = _lifted(log, grid_s)
    throttle = _throttle(log)
    return Motion(
        name=log.source.name,
        day=day_of(log),
        time_s=grid_s,
        commands_us={axis: one.on(grid_s, held=True) for axis, one in commands.items()},
        rates_deg_s=np.array([one.on(grid_s) for one in rates]),
        accelerations_m_s2=np.array([one.on(grid_s) for one in forces]),
        roll_deg=roll_deg,
        pitch_deg=pitch_deg,
        airspeed_m_s=airspeed.on(grid_s),
        throttle=np.zeros(grid_s.size) if throttle is None else throttle.on(grid_s, held=True),
        present=present_on(grid_s, every) & ~lifted,
        airspeed_source=source,
        members=members | {"thrust": ("engine",)},
        lifted_share=float(lifted.mean()),
    )


def _series(log: FlightLog, name: str, scale: float = 1.0) -> Series | None:
    if name not in log.channels:
        return None
    series = Series.of(log[name])
    return Series(series.time_s, scale * series.values) if series.values.size > 1 else None


def _vector(log: FlightLog, stems: tuple[str, ...], scale: float, size: int = 3) -> list[Series]:
    for stem in stems:
        found = [one for k in range(size) if (one := _series(log, f"{stem}[{k}]", scale)) is not None]
        if len(found) == size:
            return found
    raise NoMeasurement(f"{log.label}: no {stems[0].partition('[')[0]}: motion cannot be judged without")


def _commands(log: FlightLog) -> tuple[dict[str, Series], dict[str, tuple[str, ...]]]:
    """What was asked of each axis, as from 1000 to 2000 us, and its surfaces."""
    found: dict[str, list[tuple[Series, float, str]]] = {}
    for k in range(_MOST_SERVOS):
        kind = int(log.parameters.get(f"CA_SV_CS{k}_TYPE", 0.0))
        series = _series(log, f"actuator_servos[0].control[{k}]", _HALF_TRAVEL_US)
        if series is None or kind == 0:
            continue
        given = {axis: log.parameters.get(f"CA_SV_CS{k}_TRQ_{letter}", 0.0) for axis, letter in _AXES.items()}
        name = PX4_TYPES.get(kind, "any").replace("any", f"servo_{k + 1}")
        shares = {axis: float(np.sign(torque)) for axis, torque in given.items() if torque} or _shares(name)
        for axis, sign in shares.items():
            found.setdefault(axis, []).append((series, sign, name))
    if found:
        commands = {
            axis: Series(
                parts[0][0].time_s, np.mean([sign * _held(one, parts[0][0]) for one, sign, _ in parts], axis=0)
            )
            for axis, parts in found.items()
        }
        return commands, {_MEMBERS[axis]: tuple(name for _, _, name in parts) for axis, parts in found.items()}
    for topic in ("actuator_controls_1[0]", "actuator_controls_0[0]"):  # of a VTOL's wing, and of a fixed wing
        old = {
            axis: one
            for axis, k in _CONTROLS.items()
            if (one := _series(log, f"{topic}.control[{k}]", _HALF_TRAVEL_US)) is not None and np.ptp(one.values) > 0.0
        }
        if old:
            return old, {_MEMBERS[axis]: () for axis in old}
    raise NoMeasurement(
        f"{log.label}: no commands of surfaces (actuator_servos with CA_SV_CS*_TYPE, or actuator_controls)"
    )


def _held(series: Series, like: Series) -> FloatArray:
    """Values of one series at the times of another."""
    if series.time_s is like.time_s:
        return series.values
    place = np.clip(np.searchsorted(series.time_s, like.time_s, side="right") - 1, 0, series.time_s.size - 1)
    return series.values[place]


def _attitude(q: list[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Bank and pitch from the attitude's quaternion [deg]."""
    w, x, y, z = q
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x**2 + y**2))
    pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    return np.degrees(roll), np.degrees(pitch)


def _airspeed(log: FlightLog) -> tuple[Series, str]:
    for name in ("airspeed_validated[0].true_airspeed_m_s", "airspeed[0].true_airspeed_m_s"):
        sensor = _series(log, name)
        if sensor is not None and float(np.max(sensor.values)) > 1.0:
            return sensor, "sensor"
    ground = [_series(log, f"vehicle_local_position[0].{one}") for one in ("vx", "vy", "vz")]
    for topic in ("wind[0]", "wind_estimate[0]"):
        wind = [_series(log, f"{topic}.windspeed_{one}") for one in ("north", "east")]
        parts = [one for one in (*ground, *wind) if one is not None]
        if len(parts) == 5:
            vx, vy, vz, north, east = parts
            blown = [np.interp(vx.time_s, one.time_s, one.values) for one in (north, east)]
            speed = np.sqrt((vx.values - blown[0]) ** 2 + (vy.values - blown[1]) ** 2 + vz.values**2)
            return Series(vx.time_s, speed), "GPS and wind"
    raise NoMeasurement(
        f"{log.label}: no airspeed_validated, nor ground speed with wind: motion cannot be judged without"
    )


def _throttle(log: FlightLog) -> Series | None:
    for name in ("vehicle_thrust_setpoint[1].xyz[0]", "vehicle_thrust_setpoint[0].xyz[0]"):
        found = _series(log, name)
        if found is not None and float(np.max(found.values)) > 0.0:
            return found
    for topic in ("actuator_controls_1[0]", "actuator_controls_0[0]"):
        found = _series(log, f"{topic}.control[{_THROTTLE_CONTROL}]")
        if found is not None and float(np.max(found.values)) > 0.0:
            return found
    return None


def _lifted(log: FlightLog, grid_s: FloatArray) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Where motors carry a VTOL."""
    state = _series(log, "vtol_vehicle_status[0].vehicle_vtol_state")
    if state is not None:
        return np.asarray(_held(state, Series(grid_s, grid_s)) != _FORWARD)
    old = [_series(log, f"vtol_vehicle_status[0].vtol_in_{mode}") for mode in ("rw_mode", "trans_mode")]
    return np.asarray(sum(_held(one, Series(grid_s, grid_s)) for one in old if one is not None) + 0.0 * grid_s > 0.0)
