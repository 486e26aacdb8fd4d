"""Effects on the command: when it reaches the servo, and how fast the set point follows it."""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import numpy as np

from servofd.core.series import latest
from servofd.core.types import FloatArray
from servofd.servo.effect import HARDLY_EVER, Effect, Now, Parameter, Slot

_RATES_DEG_S = (20.0, 30.0, 45.0, 60.0, 80.0, 105.0, 140.0, 180.0, 240.0, 320.0, 420.0, 600.0)
"""Largest speeds from which a search starts: of hobby and industrial servos, each a third above the one before."""
LARGEST_SPEED = partial(
    Parameter, "rate_limit_deg_s", low=2.0, high=3e3, neutral=3e3, typical=60.0, grid=_RATES_DEG_S, off=math.inf
)
"""Of all rate limits; each has fields of its own."""
_STEPS_DEG = (360.0 / 4096.0, *(round(0.1 + 0.05 * k, 2) for k in range(39)), 0.18, 360.0 / 1024.0, 2.5, 3.0)
"""Steps of converters from which a search starts: of 10 and 12 bits a turn, and round numbers."""
STEP = partial(Parameter, "step_deg", low=0.02, high=10.0, neutral=0.0, typical=0.1, grid=_STEPS_DEG, kinked=True)
"""Of a command and of a reading; each has a field of its own."""
_DELAYS_S = (0.0, 0.01, 0.02, 0.035, 0.06, 0.1, 0.16, 0.25)
"""Delays of commands from which a search starts."""
_OFFSETS_S = (-0.15, -0.08, -0.04, -0.02, 0.01, 0.03, 0.06, 0.12, 0.2)
"""Lags of stamps from which a search starts."""


class Commands(NamedTuple):
    """Commands as they reach the servo, of shape (n,): at each instant a value, from which it runs on at a slope."""

    effective_s: FloatArray
    command_deg: FloatArray
    slope_deg_s: FloatArray

    def at(self, time_s: FloatArray) -> FloatArray:
        """The last command that had reached the servo at some instants [deg]."""
        return latest(self.effective_s, self.command_deg, time_s)

    def later(self, delay_s: float) -> Commands:
        """The same commands, so much later."""
        return self._replace(effective_s=self.effective_s + delay_s)


class CommandSteps(Effect):
    """Steps of the command."""

    name, slot, form, rank, surprise = "quantization", Slot.EVENTS, "command", 23, HARDLY_EVER
    spoken = "coarse steps"
    parameters = (STEP(fields=("command_step_deg",)),)

    @staticmethod
    def act(commands: Commands, step_deg: float) -> Commands:
        return commands._replace(command_deg=step_deg * np.round(commands.command_deg / step_deg))


class PwmFrame(Effect):
    """Commands wait for the next pulse frame."""

    name, slot, rank = "pwm_frame", Slot.EVENTS, 21
    spoken = "commands that wait for pulse frames"
    parameters = (
        Parameter("period_s", ("frame_s",), 2e-3, 0.2, 0.0, 0.02, (), kinked=True, width=2e-6),
        Parameter("phase", ("frame_phase",), -1.0, 2.0, 0.0, 0.5, (), kinked=True, width=0.06),
    )

    @staticmethod
    def act(commands: Commands, period_s: float, phase: float) -> Commands:
        begin, end = (commands.effective_s[[0, -1]] / period_s - phase).tolist()
        first, last = np.ceil(begin), np.floor(end) + 1.0
        return in_frames(commands, np.arange(first, max(last, first) + 1.0), period_s, phase)


def in_frames(commands: Commands, frames: FloatArray, period_s: float, phase: float) -> Commands:
    """What pulse frames of some numbers carry: the command in force when each begins."""
    sent_s, command_deg, slope_deg_s = commands
    frame_s = (frames + phase) * period_s
    held = np.maximum(np.searchsorted(sent_s, frame_s, side="right") - 1, 0)
    since_s = np.maximum(frame_s - sent_s[held], 0.0)
    return Commands(frame_s, command_deg[held] + slope_deg_s[held] * since_s, np.zeros(frames.size))


class Delay(Effect):
    """Total transport delay of the command."""

    name, slot, family, rank = "delay", Slot.EVENTS, "lag", 3
    spoken = "a longer delay"
    varies = True
    parameters = (Parameter("delay_s", ("delay_s",), 0.0, 0.5, 0.0, 0.003, _DELAYS_S, smallest=0.004),)

    @staticmethod
    def act(commands: Commands, delay_s: float) -> Commands:
        return commands.later(delay_s)


class ClockOffset(Effect):
    """Positions stamped too late (positive) or too early."""

    name, slot, family, rank = "clock_offset", Slot.EVENTS, "lag", 4
    spoken = "positions stamped late"
    surprise, instead = 4.0, ("delay",)
    parameters = (Parameter("offset_s", ("offset_s",), -0.5, 0.5, 0.0, 0.003, _OFFSETS_S, smallest=0.004),)
    act = Delay.act


class CommandGain(Effect):
    """Scale of the command, before the dead band and the loads: what a calibration calls gain."""

    name, slot, searched = "command_gain", Slot.COMMAND, False
    parameters = (Parameter("gain", ("command_gain",), 0.05, 3.0, 1.0, 0.15),)

    @staticmethod
    def act(x: float, now: Now, gain: float) -> float:
        return gain * x


class SetPointRate(Effect):
    """Largest speed of the set point: firmware that lets no step through to the position loop."""

    name, slot, form, rank, memory = "rate_limit", Slot.COMMAND, "set point", 8, 1
    spoken, varies = "a rate limit", True
    parameters = (LARGEST_SPEED(fields=("set_point_deg_s",)),)

    @staticmethod
    def act(x: float, now: Now, rate_deg_s: float, point: float) -> tuple[float, float]:
        most = rate_deg_s * now.step_s
        travel = x - point
        if abs(travel) >= most:
            step = most if travel > 0.0 else -most
            return point + 0.5 * step, point + step
        # Where it is on the average of a step in which it arrives.
        return x - 0.5 * travel * abs(travel) / most, x
