"""Command sequences: a FASER-like flight, and the bench tests of thesis 3.2."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from servofd.types import FloatArray

__all__ = ["COMMANDS", "chirp", "doublets", "flight", "steps"]

_ACTIVITY_DEG = 0.6
_ACTIVITY_HZ = 1.5
_FIRST_TURN_S = 8.0
_LEG_S = 12.0
_TURN_S = 7.0


def flight(time_s: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Rectangular pattern: autopilot activity on the legs, brisk inputs into and out of 180-degree turns.

    The first turn begins 8 s after the start, as in thesis Fig. 4.5. Inputs of 4 to 12 deg are reached in 0.08 to
    0.3 s, the pace of a pilot (at most about 200 deg/s); slower ones could not be detected within the thesis'
    0.08 s.

    Parameters
    ----------
    time_s : ndarray, shape (n,)
        Uniform times [s].
    rng : numpy Generator
        Source of the variation.

    Returns
    -------
    ndarray, shape (n,)
        Command [deg].
    """
    command_deg = _activity(time_s, rng)
    begin_s = time_s[0] + _FIRST_TURN_S
    while begin_s < time_s[-1]:
        size_deg = rng.uniform(4.0, 12.0) * rng.choice([-1.0, 1.0])
        for sign, at_s in ((1.0, begin_s), (-1.0, begin_s + _TURN_S)):
            rise_s, hold_s = rng.uniform(0.08, 0.3), rng.uniform(0.4, 1.0)
            _add_pulse(command_deg, sign * size_deg, time_s, at_s, rise_s, hold_s)
        begin_s += _TURN_S + rng.uniform(0.7, 1.3) * _LEG_S
    return command_deg


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
    function.__name__: function for function in (flight, chirp, steps, doublets)
}
"""Command sequences by name."""


def _activity(time_s: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Smooth autopilot activity: white noise through two lags at 1.5 Hz, 0.6 deg rms."""
    from scipy.signal import lfilter

    lag = np.exp(-2.0 * np.pi * _ACTIVITY_HZ * float(np.median(np.diff(time_s))))
    settle = int(np.ceil(10.0 / (1.0 - lag)))
    noise = rng.standard_normal(time_s.size + settle)
    smooth = lfilter([1.0], np.convolve([1.0, -lag], [1.0, -lag]), noise)[settle:]
    # The exact standard deviation of two equal lags under white noise, so that no draw is rescaled.
    deviation = np.sqrt((1.0 + lag**2) / (1.0 - lag**2) ** 3)
    activity: FloatArray = _ACTIVITY_DEG * smooth / deviation
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
