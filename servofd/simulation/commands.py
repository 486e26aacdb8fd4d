"""Command sequences: a FASER-like flight and other ways to fly, and the bench tests of thesis 3.2.

What the docstrings call measured is the median over 20 seeds of 120 s at 100 Hz.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from servofd.core.types import FloatArray
from servofd.servo.loops import lagged_twice

_FIRST_TURN_S = 8.0
"""Start of the first turn of the pattern [s]."""
_LEG_S = 12.0
"""Usual length of a leg between two turns [s]."""
_TURN_S = 7.0
"""Length of a turn [s]."""
_STICK_DEG = 15.0
"""Deflection of a stick at its end [deg]."""


class _Style(NamedTuple):
    """How a rectangular pattern is flown; the defaults are an autopilot's in fair weather."""

    activity_deg: float = 0.6
    activity_hz: float = 1.5
    turn_deg: tuple[float, float] = (4.0, 12.0)
    rise_s: tuple[float, float] = (0.08, 0.3)
    leg_s: float = _LEG_S


def flight(time_s: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Rectangular pattern: autopilot activity on the legs, fast inputs into and out of 180-degree turns.

    The first turn begins 8 s after the start, as in thesis Fig. 4.5. Inputs of 4 to 12 deg are reached in 0.08 to
    0.3 s, the pace of a pilot (at most about 200 deg/s); slower ones could not be detected within the thesis'
    0.08 s.

    `time_s` (shape (n,)): uniform times [s]. Result (shape (n,)): command [deg].
    """
    return _pattern(time_s, rng, _Style())


def calm(time_s: FloatArray, rng: np.random.Generator) -> FloatArray:
    """In still air: inputs of 2 to 6 deg in 0.5 to 1.2 s (measured: 1.6 deg rms, peak rate 17 deg/s)."""
    return _pattern(time_s, rng, _Style(0.3, 1.0, (2.0, 6.0), (0.5, 1.2)))


def gusty(time_s: FloatArray, rng: np.random.Generator) -> FloatArray:
    """In gusts, with turns twice as often (measured: 3.1 deg rms, peak rate 172 deg/s)."""
    return _pattern(time_s, rng, _Style(1.2, 2.0, leg_s=_LEG_S / 2.0))


def cruise(time_s: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Trim activity, a slow turn about once a minute (measured: 0.2 deg rms, peak rate 2 deg/s)."""
    return _pattern(time_s, rng, _Style(0.12, 0.5, (0.4, 0.9), (1.5, 3.0), 5.0 * _LEG_S))


def hand_flown(time_s: FloatArray, rng: np.random.Generator) -> FloatArray:
    """By hand: 1 to 8 deg every 1.2 s or so, 0.1 to 0.5 s each way (measured: 3.5 deg rms, peak rate 110 deg/s)."""
    command_deg = _activity(time_s, rng, 0.15, 0.5)
    begin_s = time_s[0] + rng.exponential(1.2)
    while begin_s < time_s[-1]:
        size_deg = rng.uniform(1.0, 8.0) * rng.choice([-1.0, 1.0])
        _add_pulse(command_deg, size_deg, time_s, begin_s, rng.uniform(0.1, 0.5), rng.uniform(0.1, 0.8))
        begin_s += rng.exponential(1.2)
    return np.clip(command_deg, -_STICK_DEG, _STICK_DEG)


def chirp(time_s: FloatArray, rng: np.random.Generator) -> FloatArray:  # noqa: ARG001 - all commands share a form
    """Sweep of +-4 deg from 1 to 25 Hz over the whole time (thesis 3.2.3)."""
    elapsed_s = time_s - time_s[0]
    slope_hz_s = (25.0 - 1.0) / max(float(elapsed_s[-1]), 1e-9)
    sweep: FloatArray = 4.0 * np.sin(2.0 * np.pi * (1.0 * elapsed_s + 0.5 * slope_hz_s * elapsed_s**2))
    return sweep


def steps(time_s: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Steps to random levels within +-12 deg, one every 1.5 s."""
    index = ((time_s - time_s[0]) / 1.5).astype(int)
    levels = np.append(0.0, rng.uniform(-12.0, 12.0, index.max()))
    command_deg: FloatArray = levels[index]
    return command_deg


def doublets(time_s: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Doublets of 4 to 10 deg, one every 4 s, the manoeuvre of identification flights."""
    command_deg = np.zeros(time_s.size)
    for begin_s in np.arange(time_s[0] + 2.0, time_s[-1], 4.0):
        size_deg = rng.uniform(4.0, 10.0)
        _add_pulse(command_deg, size_deg, time_s, begin_s, 0.1, 0.4)
        _add_pulse(command_deg, -size_deg, time_s, begin_s + 0.6, 0.1, 0.4)
    return command_deg


COMMANDS: dict[str, Callable[[FloatArray, np.random.Generator], FloatArray]] = {
    function.__name__: function for function in (flight, chirp, steps, doublets, calm, gusty, hand_flown, cruise)
}
"""Command sequences by name."""
FORMER_NAMES = {"lively": "gusty"}
"""Names of the release before, which are understood."""


def _pattern(time_s: FloatArray, rng: np.random.Generator, style: _Style) -> FloatArray:
    """Legs and 180-degree turns, an input into each turn and one out of it."""
    command_deg = _activity(time_s, rng, style.activity_deg, style.activity_hz)
    begin_s = time_s[0] + _FIRST_TURN_S
    while begin_s < time_s[-1]:
        size_deg = rng.uniform(*style.turn_deg) * rng.choice([-1.0, 1.0])
        for sign, at_s in ((1.0, begin_s), (-1.0, begin_s + _TURN_S)):
            rise_s, hold_s = rng.uniform(*style.rise_s), rng.uniform(0.4, 1.0)
            _add_pulse(command_deg, sign * size_deg, time_s, at_s, rise_s, hold_s)
        begin_s += _TURN_S + rng.uniform(0.7, 1.3) * style.leg_s
    return command_deg


def _activity(time_s: FloatArray, rng: np.random.Generator, rms_deg: float, corner_hz: float) -> FloatArray:
    """Smooth autopilot activity: white noise through two equal lags."""
    lag = np.exp(-2.0 * np.pi * corner_hz * float(np.median(np.diff(time_s))))
    settle = int(np.ceil(10.0 / (1.0 - lag)))
    noise = rng.standard_normal(time_s.size + settle)
    smooth = lagged_twice(noise, lag)[settle:]
    # The exact standard deviation of two equal lags under white noise, so that no draw is rescaled.
    deviation = np.sqrt((1.0 + lag**2) / (1.0 - lag**2) ** 3)
    activity: FloatArray = rms_deg * smooth / deviation
    return activity


def _add_pulse(
    command_deg: FloatArray, size_deg: float, time_s: FloatArray, begin_s: float, rise_s: float, hold_s: float
) -> None:
    """Add to `command_deg` a pulse with smooth flanks: up from `begin_s` in `rise_s`, held, and back."""
    during = slice(*np.searchsorted(time_s, (begin_s, begin_s + 2.0 * rise_s + hold_s)).tolist())
    at_s = time_s[during]
    up = _smooth_step((at_s - begin_s) / rise_s)
    down = _smooth_step((at_s - begin_s - rise_s - hold_s) / rise_s)
    command_deg[during] += size_deg * (up - down)


def _smooth_step(x: FloatArray) -> FloatArray:
    """From 0 to 1 along half a cosine."""
    return 0.5 - 0.5 * np.cos(np.pi * np.clip(x, 0.0, 1.0))
