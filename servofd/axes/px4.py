"""Motion of a PX4 log: which surface serves which axis, as its control allocation says, and how the aircraft moved."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from logparsers.records import FlightLog
from servofd.aircraft.outputs import HALF_TRAVEL_US, PX4_FIRST_SERVO, PX4_MOST_SERVOS, PX4_TYPES, WITHOUT_SURFACES
from servofd.axes.motion import (
    ALL_NEEDED,
    AXIS_OF,
    DEG,
    GPS,
    Asked,
    Motion,
    Series,
    airspeed_among,
    at_times_of_first,
    chosen,
    on_one_grid,
    series_of,
    through_the_wind,
)
from servofd.core.errors import NoMeasurement
from servofd.core.series import latest
from servofd.core.types import BoolArray, FloatArray

_AXES = {"roll": "R", "pitch": "P", "yaw": "Y"}
_THROTTLE_CONTROL = 3
"""Place of the throttle among the controls of actuator_controls."""
_MOVES = {"aileron": ("roll",), "elevator": ("pitch",), "rudder": ("yaw",), "elevon": ("roll", "pitch")}
_MOVES |= {"vtail": ("pitch", "yaw")}
"""Axes of a surface where no CA_SV_CSk_TRQ_* says them (ActuatorEffectivenessControlSurfaces)."""
_AGAINST = {"roll": "left", "yaw": "right"}
"""Side whose surface turns the aircraft the other way."""
_FORWARD = 4
"""vehicle_vtol_state of a VTOL that flies as a fixed wing."""
_PWM_OUTPUTS = [f"PWM_{bank}_{{}}{k}" for bank in ("MAIN", "AUX") for k in range(1, 17)]
"""Parameters of the 16 outputs that a bank has at most; the braces hold FUNC, MIN, MAX or REV."""


@dataclass(frozen=True, slots=True, eq=False)
class Control(Series):
    """What was asked of one surface, or of one axis where mixers turn it into outputs.

    `values`: from -1 at the MIN of its output to 1 at MAX, reversed outputs turned round. `axes`: sign of what it does
    to each. `trim`: in the same unit as the values. `span_us`: of its output, from end to end [us].
    """

    name: str
    axes: Mapping[str, float]
    trim: float = 0.0
    span_us: float = 2.0 * HALF_TRAVEL_US


def controls_of(log: FlightLog) -> tuple[Control, ...]:
    """Surfaces of the control allocation; of a log from before it (PX4 1.13), the commands of the axes."""
    kinds = [int(log.parameters.get(f"CA_SV_CS{k}_TYPE", 0.0)) for k in range(PX4_MOST_SERVOS)]
    found = []
    for k, kind in enumerate(kinds):
        series = series_of(log, f"actuator_servos[0].control[{k}]")
        if series is None or kind == 0:
            continue
        word = PX4_TYPES.get(kind, "any").replace("any", "servo")
        name = f"{word}_{k + 1}" if word == "servo" or kinds.count(kind) > 1 else word
        given = {axis: log.parameters.get(f"CA_SV_CS{k}_TRQ_{letter}", 0.0) for axis, letter in _AXES.items()}
        axes = {axis: float(np.sign(torque)) for axis, torque in given.items() if torque} or _shares(word)
        trim = log.parameters.get(f"CA_SV_CS{k}_TRIM", 0.0)
        found.append(Control(series.time_s, series.values, name, axes, trim, _span_us(log, k)))
    if any(control.axes for control in found):
        return tuple(found)
    for topic in ("actuator_controls_1[0]", "actuator_controls_0[0]"):  # of a VTOL's wing, and of a fixed wing
        old = [(axis, series_of(log, f"{topic}.control[{k}]")) for k, axis in enumerate(_AXES)]
        moved = [(axis, one) for axis, one in old if one is not None and np.ptp(one.values) > 0.0]
        if moved:
            return tuple(Control(one.time_s, one.values, f"command of {axis}", {axis: 1.0}) for axis, one in moved)
    return ()


def _shares(word: str) -> dict[str, float]:
    """What a surface of this name does to each axis."""
    kind, _, side = word.partition("_")
    return {axis: -1.0 if _AGAINST.get(axis) == side else 1.0 for axis in _MOVES.get(kind, ())}


def _span_us(log: FlightLog, k: int) -> float:
    for output in _PWM_OUTPUTS:
        if log.parameters.get(output.format("FUNC")) == PX4_FIRST_SERVO + k:
            most, least = log.parameters.get(output.format("MAX")), log.parameters.get(output.format("MIN"))
            if most is not None and least is not None:
                return most - least
    return 2.0 * HALF_TRAVEL_US


def motion_of_px4(log: FlightLog, rate_hz: float | None = None) -> Motion:
    """Motion of a ULog; of a VTOL while it flies forward."""
    if log.vehicle in WITHOUT_SURFACES:
        raise NoMeasurement(
            f"{log.label}: a {log.vehicle}: no control surfaces to judge; its outputs {WITHOUT_SURFACES[log.vehicle]}"
        )
    if "tailsitter" in log.vehicle:
        raise NoMeasurement(f"{log.label}: a {log.vehicle}: its axes change places in forward flight: not judged")
    controls = controls_of(log)
    served = {axis: [one for one in controls if axis in one.axes] for axis in _AXES}
    served = {axis: parts for axis, parts in served.items() if parts}
    if not served:
        raise NoMeasurement(
            f"{log.label}: no commands of surfaces (actuator_servos with CA_SV_CS*_TYPE, or actuator_controls)"
        )
    throttle = _throttle(log)

    def asked(grid_s: FloatArray) -> Asked:
        commands = {
            axis: HALF_TRAVEL_US * np.mean([one.axes[axis] * one.on(grid_s, held=True) for one in parts], axis=0)
            for axis, parts in served.items()
        }
        pulled = np.zeros(grid_s.size) if throttle is None else throttle.on(grid_s, held=True)
        return commands, pulled, _lifted(log, grid_s)

    surfaces = {AXIS_OF[axis]: tuple(one.name for one in parts) for axis, parts in served.items()}
    if not any(log.parameters.get(f"CA_SV_CS{k}_TYPE") for k in range(PX4_MOST_SERVOS)):
        surfaces = dict.fromkeys(surfaces, ())  # mixers made the outputs of it
    return on_one_grid(
        log,
        rate_hz,
        asked,
        controls,
        _vector(log, ("vehicle_angular_velocity[0].xyz", "sensor_combined[0].gyro_rad"), DEG),
        _vector(log, ("vehicle_acceleration[0].xyz", "sensor_combined[0].accelerometer_m_s2")),
        _attitude(_vector(log, ("vehicle_attitude[0].q",), size=4)),
        _airspeed(log),
        members=surfaces | {"thrust": ("engine",)},
    )


def _vector(log: FlightLog, stems: tuple[str, ...], scale: float = 1.0, size: int = 3) -> list[Series]:
    choices = [([f"{stem}[{k}]" for k in range(size)], scale) for stem in stems]
    return chosen(log, choices, f"no {stems[0].partition('[')[0]}: {ALL_NEEDED}")


def _attitude(q: list[Series]) -> tuple[Series, Series]:
    """Bank and pitch from the attitude's quaternion [deg]."""
    w, x, y, z = at_times_of_first(q)
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x**2 + y**2))
    pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    return Series(q[0].time_s, np.degrees(roll)), Series(q[0].time_s, np.degrees(pitch))


def _airspeed(log: FlightLog) -> tuple[Series, str]:
    sensors = ("airspeed_validated[0].true_airspeed_m_s", "airspeed[0].true_airspeed_m_s")
    ground = [f"vehicle_local_position[0].v{axis}" for axis in "xyz"]
    winds = [[f"{topic}.windspeed_{way}" for way in ("north", "east")] for topic in ("wind[0]", "wind_estimate[0]")]
    witnesses = [(series_of(log, name), "sensor") for name in sensors]
    witnesses += [(through_the_wind(log, [*ground, *wind]), GPS) for wind in winds]
    return airspeed_among(log, witnesses, f"no airspeed_validated, nor ground speed with wind: {ALL_NEEDED}")


def _throttle(log: FlightLog) -> Series | None:
    wing = ("vehicle_thrust_setpoint[1].xyz[0]", "vehicle_thrust_setpoint[0].xyz[0]")  # of a VTOL's, and a fixed one
    old = [f"actuator_controls_{group}[0].control[{_THROTTLE_CONTROL}]" for group in (1, 0)]
    found = (series_of(log, name) for name in (*wing, *old))
    return next((one for one in found if one is not None and float(np.max(one.values)) > 0.0), None)


def _lifted(log: FlightLog, grid_s: FloatArray) -> BoolArray:
    """Where motors carry a VTOL."""
    state = series_of(log, "vtol_vehicle_status[0].vehicle_vtol_state")
    if state is not None:
        return np.asarray(latest(state.time_s, state.values, grid_s) != _FORWARD)
    lifted = np.zeros(grid_s.size, dtype=bool)
    for mode in ("rw_mode", "trans_mode"):
        one = series_of(log, f"vtol_vehicle_status[0].vtol_in_{mode}")
        if one is not None:
            lifted |= latest(one.time_s, one.values, grid_s) > 0.0
    return lifted
