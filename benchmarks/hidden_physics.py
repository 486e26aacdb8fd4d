"""Logs in which an effect is hidden, to measure whether `servofd explain` finds it.

``hidden(seed, effects, excitation, noise_deg)`` is the same for ever. The servo is that of `hidden_servo`: motor, loop
and linkage with constants of their own, into which the effects and parameters of the contract are translated here.
Beside those of the catalogue there is physics with another law than the catalogue's (`STRUCTURAL`), and faults that no
effect describes (`OUTSIDE`). Only the ways to fly come from servofd.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.signal import lfilter

from hidden_servo import STEP_S, Machine, Motor, run
from servofd.simulation.commands import COMMANDS

if TYPE_CHECKING:
    from servofd.core.types import FloatArray

__all__ = [
    "CATALOGUE", "CONVERTER_DEG", "EXCITATIONS", "LEVELS", "OUTSIDE", "STRUCTURAL", "Air", "Effects", "HiddenRecord",
    "change_deg", "deflection", "draw", "effect_rms_deg", "hidden", "sweep",
]  # fmt: skip

Effects = Mapping[str, Mapping[str, float]]
"""Name of each effect, and its parameters."""
LEVELS = ("small", "medium", "large")
_Sizes = dict[str, dict[str, tuple[float, float, float]]]

CATALOGUE: _Sizes = {
    "delay": {"delay_s": (0.009, 0.016, 0.035)},
    "slow_dynamics": {"bandwidth_scale": (0.85, 0.7, 0.5)},
    "rate_limit": {"rate_limit_deg_s": (75.0, 50.0, 30.0)},
    "position_limit": {"lower_deg": (-6.0, -4.5, -2.5), "upper_deg": (7.0, 4.0, 3.0)},
    "deadband": {"width_deg": (0.6, 1.5, 4.0)},
    "backlash": {"width_deg": (0.4, 1.0, 3.0)},
    "friction": {"friction_deg": (0.3, 0.8, 2.0)},
    "gain": {"gain": (1.06, 0.87, 0.65)},
    "bias": {"bias_deg": (0.25, 0.8, 2.5)},
    "airload": {"deg_per_deg_pa": (2e-4, 6e-4, 2e-3)},
    "voltage_rate": {"deg_s_per_v": (12.0, 8.0, 5.0)},
    "pwm_frame": {"period_s": (0.014, 0.02, 0.05)},
    "sensor_lag": {"time_constant_s": (0.01, 0.025, 0.06)},
    "quantization": {"step_deg": (0.4, 0.9, 2.0)},
    "linkage_nonlinearity": {"arm_offset_deg": (35.0, 50.0, 62.0)},
    "resonance": {"frequency_hz": (11.0, 8.0, 4.5), "damping_ratio": (0.15, 0.1, 0.08)},
    "clock_offset": {"offset_s": (-0.012, -0.025, -0.06)},
    "gravity_load": {"droop_deg": (3.0, 10.0, 30.0)},
    "load_friction": {"share": (0.15, 0.3, 0.6)},
    "current_limit": {"knee_deg": (8.0, 3.0, 1.0)},
}
"""Effects of the contract with parameters for `LEVELS`. A clock offset is by how much positions are stamped too late:
below zero the surface seems to move before its command, which no delay explains. The weight hangs on the horn at 0 deg
and droops by what is said when its arm is level. Friction under load is a share of the motor's pull. The arm of a
non-linear linkage is off from square to its rod. The knee of a current limit is the error above which the motor's pull
grows as a root."""
STRUCTURAL: _Sizes = {
    "lugre_friction": {"friction_deg": (0.4, 0.8, 2.0), "presliding_deg": (0.1, 0.2, 0.3)},
    "set_point_speed": {"rate_deg_s": (75.0, 50.0, 30.0)},
    "cyclic_error": {"amplitude_deg": (0.2, 0.4, 0.8), "pitch_deg": (3.6, 3.6, 3.6)},
    "coloured_noise": {"rms_deg": (0.1, 0.2, 0.4), "pole": (0.9, 0.9, 0.9)},
    "stamp_jitter": {"deviation_s": (0.001, 0.003, 0.005)},
    "hard_deadband": {"width_deg": (0.6, 1.5, 4.0)},
    "bearing_load": {"friction_deg_per_deg": (0.08, 0.18, 0.4)},
    "hard_stop": {"lower_deg": (-6.0, -4.5, -2.5), "upper_deg": (7.0, 4.0, 3.0)},
}
"""Physics by another law than the catalogue's; hard: the loop sees the whole error once beyond the edge, the shaft
stalls at its stop instead of straining the linkage. Friction of a loaded bearing grows with deflection.
Jitter is that of stamps that are not true."""
OUTSIDE: _Sizes = {
    "stick_bursts": {"hold_s": (0.3, 0.6, 1.2), "every_s": (8.0, 6.0, 5.0)},
    "pot_spot": {"centre_deg": (1.5, 1.5, 1.5), "width_deg": (1.0, 1.5, 2.0), "error_deg": (1.0, 2.0, 4.0)},
    "oscillation": {"amplitude_deg": (0.3, 0.8, 2.0), "frequency_hz": (3.1, 3.1, 3.1)},
    "spikes": {"share": (0.01, 0.02, 0.03), "size_deg": (2.0, 5.0, 12.0)},
}
"""Faults that are nothing a model could contain."""

EXCITATIONS = ("flight", "doublets", "chirp", "sweep")
"""Lively flight and doublets in varying air at a falling voltage; a chirp of 4 deg and sweeps of 1, 3 and 9 deg at a
steady 20 m/s and 6 V."""
_IN_THE_AIR = ("flight", "doublets")
CONVERTER_DEG = 180.0 / 4096.0
"""Step of a converter of 12 bits for 180 deg."""
_COMMAND_DEG = 0.01  # what a log of two decimals holds is what the servo got
_STAMP_DIGITS = 4
_DELAY_S, _RATE_LIMIT_DEG_S = 0.004, 370.0
"""Thesis Eq. 3.1 and Fig. 3.10."""
_VISCOSITY_SHARES = (0.05, 0.5)
"""Eq. 3.1 does not tell how the losses of the motor are shared between bearing and winding: every seed has its own."""
_REST_S, _TAIL_S, _COARSE_S = 1.0, 0.3, 100 * STEP_S
_AIR_KG_M3 = 1.225
"""International standard atmosphere at sea level."""


@dataclass(frozen=True, slots=True, eq=False)
class HiddenRecord:
    """A log of one surface, and what is hidden in it."""

    time_s: FloatArray
    """Of shape (n,), as all others; what the log says."""
    command_deg: FloatArray
    measured_deg: FloatArray
    airspeed_m_s: FloatArray
    servo_voltage_v: FloatArray
    clean_deg: FloatArray
    """What the position sensor would have said without noise and converter; in no log."""
    truth: Effects


class Air(NamedTuple):
    """What goes on around a servo, each of shape (m,), every 10 ms from one second before the first command on."""

    time_s: FloatArray
    airspeed_m_s: FloatArray
    supply_v: FloatArray

    @classmethod
    def steady(cls, duration_s: float, airspeed_m_s: float, supply_v: float) -> Air:
        """On a bench."""
        size = round((duration_s + _REST_S + _TAIL_S) / _COARSE_S)
        return cls(
            -_REST_S + _COARSE_S * np.arange(size, dtype=np.float64),
            np.full(size, airspeed_m_s),
            np.full(size, supply_v),
        )


def draw(rng: np.random.Generator, name: str, level: str) -> dict[str, float]:
    """Parameters of an effect of about the size of a level.

    >>> 0.48 < draw(np.random.default_rng(1), "delay", "medium")["delay_s"] / 0.03 < 0.63
    True
    """
    sizes = {**CATALOGUE, **STRUCTURAL, **OUTSIDE}[name]
    factor = rng.uniform(0.9, 1.1)
    sign = rng.choice([-1.0, 1.0]) if name == "bias" else 1.0
    drawn = {key: sign * factor * values[LEVELS.index(level)] for key, values in sizes.items()}
    for key, neutral in (("gain", 1.0), ("bandwidth_scale", 1.0), ("delay_s", _DELAY_S)):
        if key in drawn:
            drawn[key] = neutral + factor * (sizes[key][LEVELS.index(level)] - neutral)
    for key in ("pole", "pitch_deg", "centre_deg"):
        if key in drawn:
            drawn[key] = sizes[key][LEVELS.index(level)]
    return {key: float(np.format_float_positional(value, 4, fractional=False)) for key, value in drawn.items()}


def hidden(
    seed: int,
    effects: Effects,
    excitation: str,
    noise_deg: float = 0.1,
    duration_s: float = 60.0,
    *,
    spread: float = 0.0,
    jitter_s: float = 0.0,
    row_loss: float = 0.0,
) -> HiddenRecord:
    """Log one surface at 100 Hz, with effects of any of the three lists in it.

    Parameters
    ----------
    seed : int
        Of everything that is drawn. Command, airspeed, voltage and noise of a seed do not depend on the effects.
    effects : mapping
        Parameters by effect; none: healthy.
    excitation : str
        One of `EXCITATIONS`.
    noise_deg : float
        Standard deviation of white noise on the position [deg], before a converter of 12 bits for 180 deg.
    duration_s : float
        Length of the log [s].
    spread : float
        Production scatter: largest relative deviation of gain, poles, damping and delay from Eq. 3.1.
    jitter_s : float
        Largest deviation of (true) time stamps from the clock's grid [s].
    row_loss : float
        Share of rows that never reached the log.

    Raises
    ------
    ValueError
        If there is no such effect or excitation.

    Examples
    --------
    >>> record = hidden(1, {"gain": {"gain": 0.8}}, "flight", 0.05)
    >>> record.time_s.size, dict(record.truth["gain"])
    (6000, {'gain': 0.8})
    """
    if unknown := set(effects) - {*CATALOGUE, *STRUCTURAL, *OUTSIDE}:
        raise ValueError(f"there is no effect {', '.join(sorted(unknown))}")
    of_seed = [seed, EXCITATIONS.index(excitation)]
    rng = np.random.default_rng(of_seed)
    grid_s: FloatArray = np.arange(round(duration_s * 100.0)) / 100.0
    shift_s = rng.uniform(-jitter_s, jitter_s, grid_s.size)
    time_s = np.maximum(grid_s + shift_s, 0.0).round(_STAMP_DIGITS)
    command_deg: FloatArray = _WAYS[excitation](grid_s, rng)
    command_deg = np.round(command_deg / _COMMAND_DEG) * _COMMAND_DEG
    air = _surroundings(duration_s, np.random.default_rng([*of_seed, 1]), excitation)
    lot = np.random.default_rng([*of_seed, 2])
    scatter = 1.0 + spread * np.random.default_rng([*of_seed, 3]).uniform(-1.0, 1.0, 4)
    share = np.random.default_rng([*of_seed, 5]).uniform(*_VISCOSITY_SHARES)
    clean_deg = deflection(effects, time_s, command_deg, air, lot, scatter, share)
    noise = np.random.default_rng([*of_seed, 4])
    read_deg = clean_deg + noise_deg * noise.standard_normal(time_s.size)
    step_deg = effects.get("quantization", {}).get("step_deg", CONVERTER_DEG)
    read_deg = step_deg * np.round(read_deg / step_deg)
    kept = noise.random(time_s.size) >= row_loss
    speed_m_s = np.interp(time_s, air.time_s, air.airspeed_m_s) + 0.1 * noise.standard_normal(time_s.size)
    voltage_v = np.interp(time_s, air.time_s, air.supply_v) + 0.01 * noise.standard_normal(time_s.size)
    truth = MappingProxyType({name: MappingProxyType(dict(values)) for name, values in effects.items()})
    stamp_s = _stamped(effects, time_s, lot)
    return HiddenRecord(
        stamp_s[kept], command_deg[kept], read_deg[kept], speed_m_s[kept], voltage_v[kept], clean_deg[kept], truth
    )


def deflection(
    effects: Effects,
    time_s: FloatArray,
    command_deg: FloatArray,
    air: Air,
    lot: np.random.Generator,
    scatter: FloatArray | None = None,
    viscosity_share: float = 0.1,
) -> FloatArray:
    """What the position sensor says without noise and converter [deg], shape (n,).

    Parameters
    ----------
    time_s, command_deg : ndarray, shape (n,)
        When each command was given [s], from 0 on, and what it asks for [deg]; the servo starts at rest at the first.
    air : Air
        From one second before that on.
    lot : numpy Generator
        Of what an effect leaves open.
    scatter : ndarray, shape (4,), optional
        What bandwidth, damping, delay and gain of the servo are multiplied with.
    viscosity_share : float
        Share of the motor's losses in its bearing.
    """
    bandwidth, damping, delay, gain = np.ones(4) if scatter is None else scatter
    motor = Motor.of(bandwidth * effects.get("slow_dynamics", {}).get("bandwidth_scale", 1.0), damping, viscosity_share)
    clipped_deg = motor.error_at(_RATE_LIMIT_DEG_S)
    machine = Machine(up_deg=clipped_deg, down_deg=clipped_deg)
    for name, values in effects.items():
        if name in _TRANSLATED:
            machine = machine._replace(**_TRANSLATED[name](motor, values))
    heard_s, heard_deg = _heard(effects, time_s, command_deg, lot)
    heard_s = heard_s + effects.get("delay", {}).get("delay_s", delay * _DELAY_S)
    pressure_pa = 0.5 * _AIR_KG_M3 * air.airspeed_m_s**2
    locked = _locked(effects, air.time_s, lot)
    sensed_deg = run(motor, machine, heard_s, gain * heard_deg, -_REST_S, air.supply_v, pressure_pa, locked)
    fine_s = -_REST_S + STEP_S * np.arange(1, sensed_deg.size + 1)
    offset_s = effects.get("clock_offset", {}).get("offset_s", 0.0)
    moved_deg = np.interp(time_s - offset_s, fine_s, sensed_deg) + effects.get("bias", {}).get("bias_deg", 0.0)
    return _spoilt(effects, moved_deg, time_s, lot)


def effect_rms_deg(record: HiddenRecord, healthy: HiddenRecord) -> float:
    """How much the effects change the position, against the same log without them, and coarse steps added [deg]."""
    step_deg = record.truth.get("quantization", {}).get("step_deg", 0.0)
    return float(np.sqrt(np.mean(change_deg(record, healthy) ** 2) + step_deg**2 / 12.0))


def change_deg(record: HiddenRecord, healthy: HiddenRecord) -> FloatArray:
    """Difference that the effects make to each sample [deg], shape (n,), if its stamp is taken at its word."""
    change: FloatArray = record.clean_deg - np.interp(record.time_s, healthy.time_s, healthy.clean_deg)
    return change


def sweep(time_s: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Sweeps of 1, 3 and 9 deg from 0.3 to 8 Hz, frequency rising geometrically, each a third of the time."""
    third_s = float(time_s[-1] - time_s[0]) / 3.0 + 1e-9
    part = ((time_s - time_s[0]) / third_s).astype(int)
    within = (time_s - time_s[0]) / third_s - part
    octaves = np.log(8.0 / 0.3)
    turns = 0.3 * third_s * np.expm1(octaves * within) / octaves
    sign = rng.choice([-1.0, 1.0])
    command_deg: FloatArray = sign * np.array([1.0, 3.0, 9.0])[part] * np.sin(2.0 * np.pi * turns)
    return command_deg


_WAYS = {"flight": COMMANDS["gusty"], "doublets": COMMANDS["doublets"], "chirp": COMMANDS["chirp"], "sweep": sweep}


_Translation = Callable[[Motor, Mapping[str, float]], dict[str, float]]
_TRANSLATED: dict[str, _Translation] = {
    "rate_limit": lambda motor, value: {
        "up_deg": motor.error_at(value.get("rate_up_deg_s", value.get("rate_limit_deg_s", _RATE_LIMIT_DEG_S))),
        "down_deg": motor.error_at(value.get("rate_down_deg_s", value.get("rate_limit_deg_s", _RATE_LIMIT_DEG_S))),
    },
    "voltage_rate": lambda motor, value: {"per_volt_deg": motor.error_at(value["deg_s_per_v"])},
    "position_limit": lambda _, value: {"low_deg": value["lower_deg"], "high_deg": value["upper_deg"]},
    "deadband": lambda _, value: {"half_dead_deg": value["width_deg"] / 2.0},
    "backlash": lambda _, value: {"half_play_deg": value["width_deg"] / 2.0},
    "friction": lambda motor, value: {"friction_pull": motor.pull_of(value["friction_deg"])},
    "load_friction": lambda _, value: {"rub_share": value["share"]},
    "current_limit": lambda _, value: {"knee_deg": value["knee_deg"]},
    "bearing_load": lambda motor, value: {"rub_pull": motor.pull_of(value["friction_deg_per_deg"])},
    "airload": lambda motor, value: {"air_pull": motor.pull_of(value["deg_per_deg_pa"])},
    "gravity_load": lambda motor, value: {"weight_pull": motor.pull_of(value["droop_deg"])},
    "gain": lambda _, value: {"gain": value["gain"]},
    "linkage_nonlinearity": lambda _, value: {"arm_rad": math.radians(value["arm_offset_deg"])},
    "resonance": lambda _, value: {
        "flex_rad_s": 2.0 * math.pi * value["frequency_hz"],
        "flex_damping": value["damping_ratio"],
    },
    "sensor_lag": lambda _, value: {"lag_s": value["time_constant_s"]},
    "lugre_friction": lambda motor, value: {
        "friction_pull": motor.pull_of(value["friction_deg"]),
        "bristle_deg": value["presliding_deg"],
    },
    "set_point_speed": lambda _, value: {"set_point_deg_s": value["rate_deg_s"]},
    "hard_deadband": lambda _, value: {"half_dead_deg": value["width_deg"] / 2.0, "hard_dead": 1.0},
    "hard_stop": lambda _, value: {"shaft_low_deg": value["lower_deg"], "shaft_high_deg": value["upper_deg"]},
}
"""What an effect is in a machine; those that are missing act elsewhere."""


def _heard(
    effects: Effects, time_s: FloatArray, command_deg: FloatArray, lot: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Commands at the ends of their way: as they are given, or one for each frame of the pulse signal."""
    period_s = effects.get("pwm_frame", {}).get("period_s")
    if period_s is None:
        return time_s, command_deg
    frame_s = np.arange(time_s[0] - lot.uniform(0.0, 1.0) * period_s, time_s[-1] + period_s, period_s)
    latest = np.clip(np.searchsorted(time_s, frame_s + 1e-9, side="right") - 1, 0, None)
    return frame_s, command_deg[latest]


def _stamped(effects: Effects, time_s: FloatArray, lot: np.random.Generator) -> FloatArray:
    """What the log says of when a row was taken, rising: the truth, or a clock that wavers about it."""
    if "stamp_jitter" not in effects:
        return time_s
    tick_s = 10.0**-_STAMP_DIGITS * np.arange(time_s.size)
    off_s = effects["stamp_jitter"]["deviation_s"] * np.clip(lot.standard_normal(time_s.size), -3.0, 3.0)
    stamp_s: FloatArray = np.maximum.accumulate(np.maximum(time_s + off_s, 0.0) - tick_s) + tick_s
    return stamp_s.round(_STAMP_DIGITS)


def _surroundings(duration_s: float, rng: np.random.Generator, excitation: str) -> Air:
    """Steady on a bench before a fan; in the air as turns, gusts and a battery make them."""
    steady = Air.steady(duration_s, 20.0, 6.0)
    if excitation not in _IN_THE_AIR:
        return steady
    at_s = steady.time_s
    phase = rng.uniform(0.0, 2.0 * np.pi, 2)
    pattern = 6.0 * np.sin(2.0 * np.pi * at_s / 37.0 + phase[0])
    gust_m_s, sag_v = (_smooth(rng, at_s.size, rms, 0.2) for rms in (1.0, 0.2))
    discharge = 8.2 - 1.8 * (at_s - at_s[0]) / (at_s[-1] - at_s[0])
    supply_v = np.clip(discharge + 0.3 * np.sin(at_s / 4.0 + phase[1]) + sag_v, 4.8, 8.4)
    return Air(at_s, np.clip(22.0 + pattern + gust_m_s, 12.0, 34.0), supply_v)


def _smooth(rng: np.random.Generator, size: int, rms: float, corner_hz: float) -> FloatArray:
    """Noise through one lag."""
    lag = np.exp(-2.0 * np.pi * corner_hz * _COARSE_S)
    smooth: FloatArray = lfilter([1.0], [1.0, -lag], rng.standard_normal(size)) * rms * np.sqrt(1.0 - lag**2)
    return smooth


def _locked(
    effects: Effects, coarse_s: FloatArray, lot: np.random.Generator
) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """When the shaft is held fast."""
    locked = np.zeros(coarse_s.size, dtype=np.bool_)
    if "stick_bursts" in effects:
        hold_s, every_s = (effects["stick_bursts"][key] for key in ("hold_s", "every_s"))
        begin_s = 2.0
        while begin_s < coarse_s[-1]:
            locked |= (coarse_s >= begin_s) & (coarse_s < begin_s + hold_s * lot.uniform(0.7, 1.3))
            begin_s += every_s * lot.uniform(0.6, 1.4)
    return locked


def _spoilt(effects: Effects, moved_deg: FloatArray, time_s: FloatArray, lot: np.random.Generator) -> FloatArray:
    """What a worn sensor or a disturbance makes of the position."""
    read_deg = moved_deg.copy()
    for name, values in effects.items():
        if name == "cyclic_error":
            read_deg += values["amplitude_deg"] * np.sin(2.0 * np.pi * moved_deg / values["pitch_deg"])
        elif name == "oscillation":
            read_deg += values["amplitude_deg"] * np.sin(2.0 * np.pi * values["frequency_hz"] * time_s)
        elif name == "coloured_noise":
            white = values["rms_deg"] * np.sqrt(1.0 - values["pole"] ** 2) * lot.standard_normal(time_s.size)
            read_deg += lfilter([1.0], [1.0, -values["pole"]], white)
        elif name == "pot_spot":
            within = np.abs(moved_deg - values["centre_deg"]) < values["width_deg"] / 2.0
            read_deg += np.where(within, values["error_deg"] * lot.uniform(-1.0, 1.0, time_s.size), 0.0)
        elif name == "spikes":
            struck = lot.random(time_s.size) < values["share"]
            read_deg += np.where(struck, values["size_deg"] * lot.choice([-1.0, 1.0], time_s.size), 0.0)
    return read_deg
