"""Commands that were lost on a link: where a servo without them stands, and how little is known of that.

Between two commands that arrived the others are taken to lie on a straight line. A command that stepped by d at an
unknown instant of a gap differs from that line, at a share s of the gap, by a standard deviation of
d sqrt(s (1 - s)); so does a random walk which ends d away (a Brownian bridge of variance d^2 / gap per second). What
went on between is not only what is left of it at the end: the walk is as lively as it lately was.

The servo passes this on. A lag passes no more of the standard deviation of its input than of the input itself, so that
the same lag, driven by the standard deviation, bounds that of the position.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from servofd.aircraft.priors import NAMES
from servofd.servo.state import compiled

if TYPE_CHECKING:
    from servofd.core.types import FloatArray

LONGEST_S: Final = 0.25
"""Between two commands; in more a servo goes a long way and comes back, and nothing shows it."""
HOLDS: Final = 1.5
"""A gap of so many periods holds a lost command."""
_MIDDLE: Final = np.pi / 8.0
"""Mean of sqrt(s (1 - s)) over the gap."""
_LATELY_S: Final = 1.0
_LN_BANDWIDTH, _LN_DAMPING, _DELAY = (NAMES.index(name) for name in ("ln_bandwidth", "ln_damping", "delay_s"))


def put_back(command_s: FloatArray, command_deg: FloatArray, period_s: float) -> tuple[FloatArray, FloatArray]:
    """Commands with those that were lost on straight lines, at the period they are sent with.

    Examples
    --------
    >>> put_back(np.array([0.0, 0.02, 0.06, 0.5]), np.array([0.0, 1.0, 3.0, 9.0]), 0.02)[1]
    array([0., 1., 2., 3., 9.])
    """
    step_s = np.diff(command_s)
    lost = (step_s > HOLDS * period_s) & (step_s <= LONGEST_S)
    pieces = np.where(lost, np.round(step_s / period_s), 1.0).astype(int)
    place = np.arange(pieces.sum()) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    share = place / np.repeat(pieces, pieces)
    filled_s = np.repeat(command_s[:-1], pieces) + share * np.repeat(step_s, pieces)
    filled_deg = np.repeat(command_deg[:-1], pieces) + share * np.repeat(np.diff(command_deg), pieces)
    return np.append(filled_s, command_s[-1:]), np.append(filled_deg, command_deg[-1:])


def new_memory() -> FloatArray:
    """Memory of `unknown_deg`: place among the commands, time, variance per second, and what the lag holds.

    Examples
    --------
    >>> new_memory().shape
    (4,)
    """
    return np.array([0.0, np.nan, 0.0, 0.0])


def unknown_deg(
    commands: tuple[FloatArray, FloatArray], period_s: float, theta: FloatArray, time_s: FloatArray, memory: FloatArray
) -> FloatArray:
    """Standard deviation of where a servo stands, for the commands that were lost, shape (m,) [deg].

    Parameters
    ----------
    commands : (command_s, command_deg)
        Those that arrived, up to the first after the last of the times, each of shape (n,).
    theta : ndarray, shape (13,)
        The servo.
    time_s : ndarray, shape (m,)
        When [s].
    memory : ndarray, shape (4,)
        From `new_memory`; is carried on.

    Examples
    --------
    >>> from servofd.aircraft.priors import PRIORS
    >>> theta = np.array([prior.value for prior in PRIORS])
    >>> asked = np.array([0.0, 0.02, 0.22, 0.24, 0.26]), np.array([0.0, 0.0, 9.0, 9.0, 9.0])
    >>> unknown_deg(asked, 0.02, theta, np.array([0.02, 0.22, 0.26]), new_memory()).round(1)
    array([0. , 3.4, 2.8])
    """
    lag_s = 2.0 * np.exp(theta[_LN_DAMPING] - theta[_LN_BANDWIDTH])
    out = np.zeros(time_s.size)
    if commands[0].size:
        _unknown(*commands, HOLDS * period_s, theta[_DELAY], lag_s, time_s, memory, out)
    return out


@compiled
def _unknown(
    command_s: FloatArray, command_deg: FloatArray, shortest_s: float, delay_s: float, lag_s: float,
    time_s: FloatArray, memory: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    place, now_s, walk, held = int(memory[0]), memory[1], memory[2], memory[3]
    if np.isnan(now_s):
        now_s = command_s[place]
    last = command_s.shape[0] - 1
    for i in range(time_s.shape[0]):
        until_s = time_s[i] - delay_s
        while now_s < until_s:
            while place < last and command_s[place + 1] <= now_s:
                place += 1
            end_s, size, here = until_s, 0.0, 0.0
            if place < last:
                end_s = min(until_s, command_s[place + 1])
                gap_s = command_s[place + 1] - command_s[place]
                here = (command_deg[place + 1] - command_deg[place]) ** 2 / gap_s
                if gap_s > shortest_s:
                    size = _MIDDLE * np.sqrt(max(walk, here) * gap_s)
            kept = np.exp(-(end_s - now_s) / lag_s)
            held = size + kept * (held - size)
            walk = here + np.exp(-(end_s - now_s) / _LATELY_S) * (walk - here)
            now_s = end_s
        out[i] = held
    memory[0], memory[1], memory[2], memory[3] = float(place), now_s, walk, held
