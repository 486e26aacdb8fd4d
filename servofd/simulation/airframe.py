"""An aeroplane that answers its surfaces: a closed loop in wind and turbulence, for flights without servo feedback.

Its structure is another than that of the axis models: coupled motion in six states of the air (Etkin and Reid, Dynamics
of Flight, 3rd ed., ch. 4), surfaces that lose effect at large angles, servos with a rate limit and a lag, turbulence as
first-order Gauss-Markov gusts on both angles and on the roll rate (the Dryden spectra at low order, MIL-F-8785C).
Derivatives are those of a foam plane of 2 kg and 1.6 m at 18 m/s, by the order of magnitude. Its autopilot writes
ArduPlane's DataFlash log (``.bin``).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from logparsers.compiled import compiled
from logparsers.dataflash.encode import encode
from logparsers.units import US_PER_S
from servofd.core.errors import ConfigError, UnknownName, suggest
from servofd.core.types import FloatArray
from servofd.servo.context import pressure_pa
from servofd.simulation.ardupilot import banner, output_parameters
from servofd.simulation.dataflash_writer import pulses, rows, words
from servofd.simulation.pulses import THROTTLE, THROTTLE_FUNCTION, functions_of

_STEP_S: Final = 0.01
"""Step of the integration [s]."""
_GRAVITY_M_S2: Final = 9.81
"""Acceleration of gravity [m/s2]."""
_USUAL_M_S: Final = 18.0
"""Airspeed for which the derivatives are given [m/s]."""
_MOST_US: Final = 450.0
"""Largest pulse from trim that the autopilot asks for [us]."""
_DEG_PER_US: Final = 0.05
"""Deflection for a microsecond of pulse [deg]."""
_LAG_S: Final = 0.06
"""Lag of a servo [s]."""
_MOST_DEG: Final = 4.0
"""Largest motion of a servo in a step of the integration [deg], its rate limit."""
_PULSES: Final = 9
"""Columns of the states of a step before those of its pulses: p, q, r, roll, pitch, speed, alpha, beta, throttle."""
_GUST_M, _GUST_M_S = 20.0, 1.5
"""Flight over which gusts are correlated [m], and their deviation in moderate turbulence [m/s]."""


_LEFT, _RIGHT = (("aileron_left", (1.0, 0.0, 0.0)), ("aileron_right", (1.0, 0.0, 0.0)))
MIXERS: Final[Mapping[str, Mapping[int, tuple[str, tuple[float, float, float]]]]] = {
    "plain": {1: _LEFT, 2: ("elevator", (0.0, 1.0, 0.0)), 4: ("rudder", (0.0, 0.0, 1.0)), 5: _RIGHT},
    "elevon": {1: ("elevon_left", (-1.0, 1.0, 0.0)), 2: ("elevon_right", (1.0, 1.0, 0.0))},
    "vtail": {1: _LEFT, 2: ("vtail_left", (0.0, 1.0, -1.0)), 4: ("vtail_right", (0.0, 1.0, 1.0)), 5: _RIGHT},
}
"""Outputs of airframes: by their number the name of the surface, and what roll, pitch and yaw ask of it."""

_KINDS: Final = ("stuck", "loss_of_effectiveness", "slow", "bias")


@dataclass(frozen=True, slots=True)
class AirframeFault:
    """What happens to a surface."""

    surface: str
    kind: str
    start_s: float
    value: float
    """Where it is stuck or how far it is off [deg], the share of travel that is left, or the lag [s]."""
    end_s: float = float("inf")
    """When it passes."""


@dataclass(frozen=True, slots=True, eq=False)
class AirframeFlight:
    """What a log holds; shape (n,) unless said."""

    surfaces: Mapping[int, str]
    """By the numbers of their outputs."""
    time_s: FloatArray
    pulses_us: FloatArray
    """Shape (n, surfaces)."""
    throttle: FloatArray
    rates_deg_s: FloatArray
    """Shape (3, n)."""
    accelerations_m_s2: FloatArray
    """Shape (3, n)."""
    roll_deg: FloatArray
    pitch_deg: FloatArray
    airspeed_m_s: FloatArray
    deflections_deg: FloatArray
    """Shape (n, surfaces): the truth."""


def fly_airframe(
    seed: int,
    *,
    mixer: str = "plain",
    duration_s: float = 180.0,
    rate_hz: float = 25.0,
    turbulence: float = 1.0,
    manoeuvres: float = 1.0,
    faults: tuple[AirframeFault, ...] = (),
    day: int | None = None,
) -> AirframeFlight:
    """Fly once.

    `mixer`: one of `MIXERS`. `duration_s`, `rate_hz`: of the log; the rate divides 100 Hz. `turbulence`: 1 is moderate:
    gusts of 1.5 m/s. `manoeuvres`: 1 banks by up to 34 deg; 2.4 is aerobatic. `faults`: one for each surface at most.
    `day`: load, trim and density are those of a day; of the seed if left out.
    """
    if mixer not in MIXERS:
        raise UnknownName(suggest("mixer", mixer, MIXERS))
    if not 10.0 <= duration_s <= 36_000.0:
        raise ConfigError(f"{duration_s:g} s: a flight lasts from 10 s to 10 h")
    surfaces = {number: name for number, (name, _) in MIXERS[mixer].items()}
    names = list(surfaces.values())
    for fault in faults:
        if fault.surface not in names:
            raise UnknownName(suggest("surface", fault.surface, names))
        if fault.kind not in _KINDS:
            raise UnknownName(suggest("fault of an airframe", fault.kind, _KINDS))
    rng = np.random.default_rng([seed, 23])
    of_day = np.random.default_rng([seed if day is None else day, 24])
    load = 1.0 + 0.03 * of_day.standard_normal(6)
    trims_us = 6.0 * of_day.standard_normal(3)
    steps = round(duration_s / _STEP_S)
    mix = np.array([weights for _, weights in MIXERS[mixer].values()])
    table = np.array([[np.inf, 0.0, 0.0, np.inf]] * len(names))
    for fault in faults:
        table[names.index(fault.surface)] = (fault.start_s, _KINDS.index(fault.kind), fault.value, fault.end_s)
    shocks, wanted = rng.standard_normal((steps, 3)), _targets(rng, steps, manoeuvres)
    states = _flown(steps, shocks, wanted, mix, table, load, trims_us, turbulence)
    every = max(1, round(1.0 / rate_hz / _STEP_S))
    states = states[::every]
    n, noise = states.shape[0], rng.standard_normal
    rates, (roll, pitch, speed), throttle = states[:, :3].T, states[:, 3:6].T, states[:, _PULSES - 1]
    sent, stands, forces = np.split(states[:, _PULSES:], [len(names), 2 * len(names)], axis=1)
    return AirframeFlight(
        surfaces,
        np.arange(n) * every * _STEP_S,
        np.round(1500.0 + sent),
        throttle,
        np.degrees(rates) + 0.3 * noise((3, n)),
        forces.T + 0.15 * noise((3, n)),
        np.degrees(roll),
        np.degrees(pitch),
        speed + 0.3 * noise(n),
        stands,
    )


def _targets(rng: np.random.Generator, steps: int, manoeuvres: float) -> FloatArray:
    """Bank, pitch, airspeed and rudder that are wanted, each held for some seconds; shape (steps, 4)."""
    found = np.zeros((steps, 4))
    for column, (low, high, shortest_s, longest_s) in enumerate(
        ((-0.6, 0.6, 3.0, 9.0), (-0.06, 0.12, 3.0, 8.0), (16.0, 21.0, 10.0, 30.0), (-80.0, 80.0, 2.0, 8.0))
    ):
        k = 0
        while k < steps:
            length = int(rng.uniform(shortest_s, longest_s) / _STEP_S)
            value = rng.uniform(low, high)
            found[k : k + length, column] = value if column < 3 or rng.random() < 0.4 else 0.0
            k += length
    return found * [manoeuvres, manoeuvres, 1.0, manoeuvres]


@compiled
def _flown(  # noqa: PLR0915 - one step of physics, in the order in which it happens
    steps: int, shocks: FloatArray, wanted: FloatArray, mix: FloatArray, faults: FloatArray, load: FloatArray,
    trims_us: FloatArray, turbulence: float,
) -> FloatArray:  # fmt: skip
    """States of every step: those before `_PULSES`, pulses, deflections, forces."""
    s = mix.shape[0]
    out = np.zeros((steps, _PULSES + 2 * s + 3))
    p = q = r = roll = pitch = 0.0
    alpha, beta, speed, thrust = 0.05, 0.0, _USUAL_M_S, 0.5
    gust_a = gust_b = gust_p = 0.0
    pulses, angles = np.zeros(s), np.zeros(s)
    norm = (mix**2).sum(axis=0)
    for k in range(steps):
        time_s = k * _STEP_S
        v = speed / _USUAL_M_S
        # The autopilot: attitude loops around rates, gains by airspeed.
        ask_roll = (700.0 * (wanted[k, 0] - roll) - 90.0 * p) / v**2
        climb = wanted[k, 1] - 0.08 * max(15.0 - speed, 0.0)  # the nose goes down before the wing stalls
        ask_pitch = (900.0 * (climb - pitch) - 160.0 * q) / v**2 + 500.0 * abs(roll) * 0.3
        ask_yaw = wanted[k, 3] - 60.0 * r + 60.0 * _GRAVITY_M_S2 / speed * np.sin(roll)
        ask = np.array([ask_roll, ask_pitch, ask_yaw])
        throttle = min(1.0, max(0.0, 0.45 + 0.12 * (wanted[k, 2] - speed) + 1.2 * pitch))
        for i in range(s):
            pulse = 0.0
            for axis in range(3):
                pulse += mix[i, axis] * min(max(ask[axis], -_MOST_US), _MOST_US)
            pulses[i] = min(max(pulse, -_MOST_US), _MOST_US)
            target, lag = _DEG_PER_US * pulses[i], _LAG_S
            if faults[i, 0] <= time_s < faults[i, 3]:
                if faults[i, 1] == 0.0:
                    angles[i] = faults[i, 2]
                    continue
                if faults[i, 1] == 1.0:
                    target *= faults[i, 2]
                elif faults[i, 1] == 2.0:
                    lag = _LAG_S + faults[i, 2]
                else:
                    target += faults[i, 2]
            change = (target - angles[i]) * _STEP_S / lag
            angles[i] += min(max(change, -_MOST_DEG), _MOST_DEG)
        given = np.zeros(3)
        for axis in range(3):
            if norm[axis] > 0.0:
                for i in range(s):
                    given[axis] += mix[i, axis] * angles[i] / norm[axis]
            given[axis] += _DEG_PER_US * trims_us[axis]
            given[axis] -= 2e-4 * given[axis] ** 3
        # Gusts: correlation over 20 m of flight.
        fade = np.exp(-speed * _STEP_S / _GUST_M)
        kick = np.sqrt(1.0 - fade * fade) * turbulence
        gust_a = fade * gust_a + kick * _GUST_M_S / speed * shocks[k, 0]
        gust_b = fade * gust_b + kick * _GUST_M_S / speed * shocks[k, 1]
        gust_p = fade * gust_p + kick * 0.25 * shocks[k, 2]
        a, b = alpha + gust_a, beta + gust_b
        da, de, dr = given[0], given[1], given[2]
        lift = load[0] * 27.5 * np.tanh((a + 0.03) / 0.25) * v**2
        side = -9.0 * b * v**2 + 0.05 * dr * v**2
        drag = 0.9 * v**2 + 0.012 * lift**2 / max(v, 0.3) ** 2
        thrust += (throttle - thrust) * _STEP_S / 0.3
        pull = load[1] * (6.0 * thrust - 0.5 * v)
        p += _STEP_S * (-9.0 * v * (p - gust_p) + 2.0 * v * r - 12.0 * b * v**2 + load[2] * 2.6 * da * v**2)
        q += _STEP_S * (-load[3] * 45.0 * (a - 0.055) * v**2 - 6.0 * v * q + load[4] * 2.2 * de * v**2 + 0.6 * thrust)
        r += _STEP_S * (16.0 * b * v**2 - 2.2 * v * r - 0.4 * v * p + load[5] * 0.9 * dr * v**2 - 0.08 * da * v**2)
        g_n = _GRAVITY_M_S2 * np.cos(roll) * np.cos(pitch)
        alpha += _STEP_S * (q + (g_n - lift) / speed)
        beta += _STEP_S * (-r + (_GRAVITY_M_S2 * np.sin(roll) * np.cos(pitch) + side) / speed)
        roll += _STEP_S * (p + np.tan(pitch) * (q * np.sin(roll) + r * np.cos(roll)))
        pitch += _STEP_S * (q * np.cos(roll) - r * np.sin(roll))
        speed = max(speed + _STEP_S * (pull - drag - _GRAVITY_M_S2 * np.sin(pitch - alpha)), 6.0)
        out[k, :_PULSES] = np.array([p, q, r, roll, pitch, speed, alpha, beta, throttle])
        out[k, _PULSES : _PULSES + s] = pulses
        out[k, _PULSES + s : _PULSES + 2 * s] = angles
        out[k, _PULSES + 2 * s :] = np.array([pull - drag + lift * alpha, side, -lift])
    return out


_VERSION: Final = "4.6.0"


def airframe_parameters(flight: AirframeFlight) -> dict[str, float]:
    """What the autopilot knows of its outputs."""
    functions = functions_of(flight.surfaces.values())
    turned = {number: functions[name] for number, name in flight.surfaces.items()}
    outputs: dict[int, dict[str, float]] = {}
    for number, function in sorted((turned | {THROTTLE: THROTTLE_FUNCTION}).items()):
        low, high = (1000.0, 2000.0) if number == THROTTLE else (1050.0, 1950.0)
        outputs[number] = {"FUNCTION": function, "TRIM": 1500.0, "REVERSED": 0.0, "MIN": low, "MAX": high}
    return output_parameters(outputs)


def airframe_log(flight: AirframeFlight) -> bytes:
    """Content of a ``.bin`` file: commands, gyros, accelerometers, attitude and airspeed."""
    stamps = np.round(US_PER_S * (flight.time_s + 5.0)).astype(np.int64)
    sent = dict(zip(flight.surfaces, flight.pulses_us.T, strict=True))
    p, q, r = np.radians(flight.rates_deg_s)
    ax, ay, az = flight.accelerations_m_s2
    pushed_pa = pressure_pa(flight.airspeed_m_s)
    pitot = {"Airspeed": flight.airspeed_m_s, "DiffPress": pushed_pa, "RawPress": pushed_pa}
    return encode(
        [
            *words(stamps[:1], airframe_parameters(flight), banner(_VERSION)),
            pulses(stamps, sent | {THROTTLE: np.round(1000.0 + 1000.0 * flight.throttle)}),
            rows("IMU", stamps, GyrX=p, GyrY=q, GyrZ=r, AccX=ax, AccY=ay, AccZ=az, T=30.0, GH=1, AH=1),
            rows("ATT", stamps, Roll=flight.roll_deg, Pitch=flight.pitch_deg, AEKF=3),
            rows("ARSP", stamps, **pitot, Temp=18.5, U=1, H=1, Hp=1),
        ]
    )
