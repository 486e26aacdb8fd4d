"""Where commands were lost whose value nobody can guess: what follows them says nothing about the servo."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servofd.detection.residual import rhythm

if TYPE_CHECKING:
    from servofd.core.types import BoolArray, FloatArray

_DOUBTFUL = 1.45
"""Times the usual interval, from which on a lost command may hide among time stamps that jitter."""
_LARGEST_GUESS_DEG, _FORGOTTEN_S = 0.25, 0.16
"""A lost command off by this much moves an HS-225BB by 0.04 deg, for four of its time constants."""
_SPANS, _NEAR = (3, 10, 50), 25
"""Commands over which the period is measured, ever better, and to either side of those whose beat is heard."""
_ON_BEAT, _STEADY = 0.4, 0.3
"""Share of a period by which a command may be off its beat (half of one is where the count goes wrong), and length of
the mean of the commands' turns on the clock: 0.5 if they are off by up to 0.3 periods, evenly; of 51 that come as they
please more than 0.3 in one of a hundred."""


def after_lost_commands(command_s: FloatArray, command_deg: FloatArray, hole_s: float, time_s: FloatArray) -> BoolArray:
    """Samples that follow a lost command that lies on no line with those around it, shape (n,).

    Commands that keep to a beat, each a little early or late, say how many were lost: the beat goes on. Where there
    is none, a lost command may hide in every interval that is merely long.

    Parameters
    ----------
    command_s, command_deg : ndarray, shape (m,)
        Time stamps [s] and commands, those that are left.
    time_s : ndarray, shape (n,)
        Of the samples [s].

    Examples
    --------
    >>> sent_s = 0.01 * np.arange(60.0)
    >>> there = np.arange(60) != 30
    >>> after = after_lost_commands(sent_s[there], 10.0 * np.cos(20.0 * sent_s[there]), 0.1, sent_s)
    >>> sent_s[after][[0, -1]]
    array([0.29, 0.46])
    """
    after = np.zeros(time_s.size, dtype=bool)
    if command_s.size < 4:
        return after
    step_s, period_s = np.diff(command_s), rhythm(command_s).period_s
    lost = step_s > _DOUBTFUL * period_s
    if np.isfinite(period_s):
        beats, sure = _beats(command_s, period_s)
        lost = np.where(sure, beats > 1.0, lost)
    lost &= step_s <= hole_s
    bend = np.abs(np.diff(command_deg, 2, prepend=command_deg[:1], append=command_deg[-1:]))
    for k in np.flatnonzero(lost & (np.maximum(bend[:-1], bend[1:]) > _LARGEST_GUESS_DEG)):
        first, last = np.searchsorted(time_s, (command_s[k], command_s[k + 1] + _FORGOTTEN_S))
        after[first:last] = True
    return after


def _beats(command_s: FloatArray, period_s: float) -> tuple[FloatArray, BoolArray]:
    """How many beats each interval is long, shape (m - 1,), and whether that is sure."""
    if command_s.size <= 2 * _NEAR + _SPANS[-1]:
        return np.ones(command_s.size - 1), np.zeros(command_s.size - 1, dtype=bool)
    for span in _SPANS:
        span_s = command_s[span:] - command_s[:-span]
        period_s = float(np.median(span_s / np.maximum(np.round(span_s / period_s), 1.0)))
    turns = np.exp(2j * np.pi * command_s / period_s)
    mean = np.convolve(turns, np.ones(2 * _NEAR + 1), "same") / np.convolve(
        np.ones(turns.size), np.ones(2 * _NEAR + 1), "same"
    )
    off = np.angle(turns * np.conj(mean)) / (2.0 * np.pi)
    fits = (np.abs(off) < _ON_BEAT) & (np.abs(mean) > _STEADY)
    beats = np.round(np.diff(command_s) / period_s - np.diff(off))
    return beats, fits[:-1] & fits[1:]
