"""A fleet of flights with known truth, to measure how well faults are found: every servo differs from the model.

``flight(seed, style, kind, size)`` is the same for ever. The servos are simulated here in small steps and with a rate
limiter of their own, and have nothing in common with servofd's kernel but the numbers of thesis Eq. 3.1: a mistake in
the kernel cannot hide itself. Only the ways to fly come from servofd.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit
from scipy.signal import butter, cont2discrete, lfilter, tf2ss

from servofd.simulation.commands import COMMANDS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servofd.core.types import FloatArray

__all__ = [
    "KINDS",
    "SIZES",
    "STYLES",
    "FleetFlight",
    "FleetServo",
    "Truth",
    "any_servo",
    "cases",
    "deflection",
    "flight",
]

STYLES = ("gusty", "calm", "chirp", "hand_flown", "cruise")
SIZES: dict[str, tuple[str, dict[str, float]]] = {
    "bias": ("bias_deg", {"small": 0.8, "medium": 1.5, "large": 3.0}),
    "stuck": ("motion_rank", {"small": 1 / 6, "medium": 1 / 2, "large": 5 / 6}),
    "deadband": ("width_deg", {"small": 1.5, "medium": 3.0, "large": 6.0}),
    "slow": ("bandwidth_scale", {"small": 0.7, "medium": 0.5, "large": 0.35}),
    "oscillation": ("amplitude_deg", {"small": 0.7, "medium": 1.5, "large": 3.0}),
    "loss_of_effectiveness": ("gain", {"small": 0.8, "medium": 0.6, "large": 0.3}),
    "floating": ("amplitude_deg", {"small": 1.5, "medium": 3.0, "large": 6.0}),
    "hardover": ("position_deg", {"small": 10.0, "medium": 20.0, "large": 35.0}),
}
"""Kinds of faults, the parameter that tells their size, and the sizes. A jam holds the position it happens to be at:
its size is how far the command goes within the next 10 s, by rank among 9 instants drawn."""
KINDS = tuple(SIZES)

_NUMERATOR, _DENOMINATOR = (122237.64,), tuple(np.polymul([1.0, 24.84], [1.0, 70.04, 4921.0]))
"""Thesis Eq. 3.1, scaled to a dc gain of one."""
_RATE_LIMIT_DEG_S = 370.0
"""Thesis Fig. 3.10."""
_STEP_S = 1e-3
_LEAST_BEFORE_S, _LEAST_AFTER_S, _MOTION_S = 2.0, 2.0, 10.0
_CANDIDATES = 9


class FleetServo(NamedTuple):
    """A servo, its feedback and its telemetry; the defaults are those of the model, without any error."""

    gain: float = 1.0
    delay_s: float = 0.004
    bandwidth_scale: float = 1.0
    bias_deg: float = 0.0
    noise_deg: float = 0.0
    step_deg: float = 0.0
    """Of the converter; 0: none."""
    jitter_s: float = 0.0
    """Largest deviation of a time stamp from the clock's grid; stamps are true."""
    loss: float = 0.0
    """Share of rows that never reached the log."""


@dataclass(frozen=True, slots=True)
class Truth:
    """What is wrong in a flight, and since when."""

    kind: str
    size: str
    start_s: float
    parameters: dict[str, float]
    motion_deg: float
    """How far the command goes from where it was at the start, up to the end of the flight."""


@dataclass(frozen=True, slots=True, eq=False)
class FleetFlight:
    """A log with its truth."""

    seed: int
    style: str
    servo: FleetServo
    truth: Truth | None
    time_s: FloatArray
    """Of shape (n,), rising, irregular."""
    command_deg: FloatArray
    """Of shape (n,): given at `time_s`, held until the next, some of which are lost."""
    measured_deg: FloatArray
    """Of shape (n,): at `time_s`."""
    moved_deg: FloatArray
    """Of shape (n,): where the surface really was, which no log tells."""


def cases() -> Iterator[tuple[str, str | None, str]]:
    """Style, kind and size of all that can be flown: 5 healthy styles and 120 with faults."""
    for style in STYLES:
        yield style, None, ""
        for kind, (_, sizes) in SIZES.items():
            for size in sizes:
                yield style, kind, size


def flight(
    seed: int,
    style: str,
    kind: str | None = None,
    size: str = "medium",
    *,
    duration_s: float = 120.0,
    rate_hz: float = 100.0,
    servo: FleetServo | None = None,
) -> FleetFlight:
    """Fly one servo once, drawn or given. Up to its fault it is the flight of the same seed and style without a fault.

    >>> one = flight(1, "gusty", "stuck", "large")
    >>> one.truth.kind, 2.0 <= one.truth.start_s <= 118.0
    ('stuck', True)
    """
    rng = np.random.default_rng([seed, STYLES.index(style)])
    drawn = any_servo(rng)
    servo = servo or drawn
    grid_s = np.arange(round(duration_s * rate_hz)) / rate_hz
    given_deg = COMMANDS[style](grid_s, rng)
    given_s = np.maximum(grid_s + rng.uniform(-servo.jitter_s, servo.jitter_s, grid_s.size), 0.0)
    noise_deg = servo.noise_deg * rng.standard_normal(grid_s.size)
    kept = rng.random(grid_s.size) >= servo.loss
    truth = None
    if kind is not None:
        lot = np.random.default_rng([seed, STYLES.index(style), KINDS.index(kind), list(SIZES[kind][1]).index(size)])
        truth = _truth(lot, kind, size, given_s, given_deg)
    moved_deg = deflection(servo, given_s, given_deg, truth)
    read_deg = moved_deg + servo.bias_deg + noise_deg
    if servo.step_deg:
        read_deg = servo.step_deg * np.round(read_deg / servo.step_deg)
    log = (given_s[kept], given_deg[kept], read_deg[kept], moved_deg[kept])
    return FleetFlight(seed, style, servo, truth, *log)


def deflection(servo: FleetServo, given_s: FloatArray, given_deg: FloatArray, truth: Truth | None = None) -> FloatArray:
    """Deflection at the instants at which commands are given [deg], shape (n,), in steps of 1 ms."""
    start_s = truth.start_s if truth else np.inf
    heard_s, heard_deg = _heard(given_s, given_deg, truth)
    grid_s = np.arange(given_s[0], given_s[-1] + 2.0 * _STEP_S, _STEP_S)
    # The mean of a held command over each step is exact to the second order in the step, whenever it changes.
    area = np.concatenate([[0.0], np.cumsum(heard_deg[:-1] * np.diff(heard_s))])
    edges_s = np.append(grid_s, grid_s[-1] + _STEP_S) - servo.delay_s
    mean_deg = np.diff(_integral(heard_s, heard_deg, area, edges_s)) / _STEP_S
    later = truth.parameters["bandwidth_scale"] if truth and truth.kind == "slow" else 1.0
    shaft_deg = np.empty(grid_s.size)
    _turn(
        *_discrete(servo.bandwidth_scale),
        *_discrete(servo.bandwidth_scale * later),
        servo.gain * mean_deg,
        servo.gain * float(given_deg[0]),
        int(np.searchsorted(grid_s, start_s)),
        _RATE_LIMIT_DEG_S * _STEP_S,
        shaft_deg,
    )
    moved_deg: FloatArray = np.interp(given_s, grid_s, shaft_deg)
    if truth is None or not np.any(given_s >= start_s):
        return moved_deg
    since = given_s >= start_s
    moved_deg[since] = _moved(truth, given_s[since] - start_s, moved_deg[since], np.interp(start_s, grid_s, shaft_deg))
    return moved_deg


def any_servo(rng: np.random.Generator) -> FleetServo:
    """Production scatter, and cheap telemetry: 12 or 10 bits for 180 deg."""
    return FleetServo(
        gain=rng.uniform(0.97, 1.03),
        delay_s=0.004 + rng.uniform(-0.003, 0.003),
        bandwidth_scale=rng.uniform(0.9, 1.1),
        bias_deg=rng.uniform(-0.3, 0.3),
        noise_deg=rng.uniform(0.05, 0.2),
        step_deg=180.0 / float(rng.choice([4096, 1024])),
        jitter_s=0.002,
        loss=rng.uniform(0.02, 0.05),
    )


def _truth(rng: np.random.Generator, kind: str, size: str, given_s: FloatArray, given_deg: FloatArray) -> Truth:
    """Draw when it happens, and what its size leaves open."""
    starts_s = rng.uniform(given_s[0] + _LEAST_BEFORE_S, given_s[-1] - _LEAST_AFTER_S, _CANDIDATES)
    name, sizes = SIZES[kind]
    start_s, parameters = float(starts_s[0]), {name: sizes[size]}
    if kind == "stuck":
        ranked = sorted(starts_s, key=lambda at_s: _motion(given_s, given_deg, at_s, _MOTION_S))
        start_s, parameters = float(ranked[int(sizes[size] * _CANDIDATES)]), {}
    elif kind in ("bias", "hardover"):
        parameters[name] *= float(rng.choice([-1.0, 1.0]))
    elif kind == "oscillation":
        parameters["frequency_hz"] = rng.uniform(1.0, 5.0)
    elif kind == "floating":
        parameters |= {"bandwidth_hz": rng.uniform(0.3, 1.5), "seed": float(rng.integers(2**31))}
    return Truth(kind, size, start_s, parameters, _motion(given_s, given_deg, start_s, np.inf))


def _motion(given_s: FloatArray, given_deg: FloatArray, start_s: float, within_s: float) -> float:
    """How far the command goes from where it is at `start_s` [deg]."""
    first, last = np.searchsorted(given_s, (start_s, start_s + within_s))
    return float(np.max(np.abs(given_deg[first:last] - given_deg[first - 1]), initial=0.0))


def _heard(given_s: FloatArray, given_deg: FloatArray, truth: Truth | None) -> tuple[FloatArray, FloatArray]:
    """What the servo makes of its commands; a fault concerns those given after its start, and the one in force then."""
    if truth is None or truth.kind not in ("bias", "loss_of_effectiveness", "deadband"):
        return given_s, given_deg
    k = int(np.searchsorted(given_s, truth.start_s))
    heard_s = np.insert(given_s, k, truth.start_s)
    heard_deg = np.insert(given_deg, k, given_deg[k - 1])
    if truth.kind == "bias":
        heard_deg[k:] += truth.parameters["bias_deg"]
    elif truth.kind == "loss_of_effectiveness":
        heard_deg[k:] *= truth.parameters["gain"]
    else:
        _rest_within(heard_deg, k, truth.parameters["width_deg"] / 2.0)
    return heard_s, heard_deg


def _moved(truth: Truth, since_s: FloatArray, shaft_deg: FloatArray, onset_deg: float) -> FloatArray:
    """Where the surface is `since_s` into the fault, if its servo has no say any more."""
    values = truth.parameters
    if truth.kind == "stuck":
        return np.full(since_s.size, onset_deg)
    if truth.kind == "hardover":
        way_deg = values["position_deg"] - onset_deg
        return onset_deg + np.sign(way_deg) * np.minimum(_RATE_LIMIT_DEG_S * since_s, abs(way_deg))
    if truth.kind == "oscillation":
        swing: FloatArray = np.sin(2.0 * np.pi * values["frequency_hz"] * since_s)
        return shaft_deg + values["amplitude_deg"] * swing
    if truth.kind == "floating":
        return onset_deg + _wind(values, since_s) - onset_deg * (1.0 - np.exp(-since_s / 0.5))
    return shaft_deg


def _wind(values: dict[str, float], since_s: FloatArray) -> FloatArray:
    """Noise through a Butterworth filter of second order, from zero, amplitude / sqrt(2) rms once it blows."""
    step_s = 0.01
    top, bottom = butter(2, values["bandwidth_hz"], fs=1.0 / step_s)
    noise = np.random.default_rng(int(values["seed"])).standard_normal(int(since_s[-1] / step_s) + 2)
    impulse = lfilter(top, bottom, np.append(1.0, np.zeros(4000)))
    smooth = lfilter(top, bottom, noise) * values["amplitude_deg"] / np.sqrt(2.0 * np.sum(impulse**2))
    return np.interp(since_s, step_s * np.arange(noise.size), smooth - smooth[0])


def _integral(at_s: FloatArray, held: FloatArray, area: FloatArray, wanted_s: FloatArray) -> FloatArray:
    """Integral of a held signal from its first instant; the first value held before, the last one after."""
    k = np.clip(np.searchsorted(at_s, wanted_s, side="right") - 1, 0, at_s.size - 1)
    integral: FloatArray = area[k] + held[k] * (wanted_s - at_s[k])
    return integral


@lru_cache(maxsize=256)
def _discrete(bandwidth_scale: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """State space of the servo for one step; the state means the same whatever the bandwidth (time is stretched)."""
    a, b, c, d = tf2ss(_NUMERATOR, _DENOMINATOR)
    ad, bd, cd, _, _ = cont2discrete((bandwidth_scale * a, bandwidth_scale * b, c, d), _STEP_S, method="zoh")
    return np.ascontiguousarray(ad), np.ascontiguousarray(bd[:, 0]), np.ascontiguousarray(cd[0])


@njit(cache=True)
def _turn(
    a: FloatArray,
    b: FloatArray,
    c: FloatArray,
    later_a: FloatArray,
    later_b: FloatArray,
    later_c: FloatArray,
    command_deg: FloatArray,
    rest_deg: float,
    change: int,
    most_deg: float,
    shaft_deg: FloatArray,
) -> None:
    """Turn the shaft step by step from rest: linear motion, followed no faster than `most_deg` a step."""
    # At rest only the last state of the controllable form is not zero, and c[-1] is the gain from it.
    order = a.shape[0]
    state, following = np.zeros(order), np.zeros(order)
    state[-1] = rest_deg / c[-1]
    shaft = rest_deg
    for k in range(command_deg.size):
        if k == change:
            a, b, c = later_a, later_b, later_c
        shaft_deg[k] = shaft
        linear = 0.0
        for i in range(order):
            following[i] = b[i] * command_deg[k]
            for j in range(order):
                following[i] += a[i, j] * state[j]
            linear += c[i] * following[i]
        state, following = following, state
        shaft += min(max(linear - shaft, -most_deg), most_deg)


@njit(cache=True)
def _rest_within(command_deg: FloatArray, first: int, half_deg: float) -> None:
    """Dead band: from `first` on what is heard moves only when the command is further than `half_deg` from it."""
    for k in range(first, command_deg.size):
        off = command_deg[k] - command_deg[k - 1]
        step = np.sign(off) * max(abs(off) - half_deg, 0.0)
        command_deg[k] = command_deg[k - 1] + step
