"""Steps of one size: in them a slow servo and one whose speed is limited look alike."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from servofd.core.types import FloatArray
    from servofd.detection.residual import Commands
    from servofd.discrepancy.record import Record

STEPS_OF_TWO_SIZES = "steps of two sizes, such as 5 and 20 deg"
_HOLDS_S, _MOSTLY = 0.15, 0.8
"""How long a command stands between steps, and for how much of its time it does."""
_ALIKE, _SMALLEST_SHARE = 1.3, 0.02
"""Ratio of the largest step to the smallest; what is smaller than that share of the largest is none."""


def step_size_deg(record: Record) -> float | None:
    """Size of the steps, if all that was asked is steps, each as large as any other.

    Examples
    --------
    >>> from servofd.discrepancy.record import record_of
    >>> from servofd.servo.servo_model import ServoModel
    >>> from servofd.aircraft.segment import Segment
    >>> from servofd.servo.library import servo_named
    >>> t = np.arange(0.0, 20.0, 0.02)
    >>> model = ServoModel.of(servo_named("s9254"))
    >>> commands = 10.0 * (t % 2.0 < 1.0), 10.0 * (t % 2.0 < 1.0) + 5.0 * (t % 4.0 < 2.0), 10.0 * np.sin(t)
    >>> [step_size_deg(record_of(Segment("x", t, u, t, u), model)) for u in commands]
    [10.0, None, None]
    """
    found = [_steps(run.commands, float(run.time_s[-1])) for run in record.runs or (record,)]
    if any(sizes is None for sizes in found):
        return None
    sizes_deg = np.concatenate([sizes for sizes in found if sizes is not None])
    sizes_deg = sizes_deg[sizes_deg > _SMALLEST_SHARE * np.max(sizes_deg, initial=0.0)]
    alike = sizes_deg.size > 0 and float(sizes_deg.max()) < _ALIKE * float(sizes_deg.min())
    return float(np.median(sizes_deg)) if alike else None


def _steps(commands: Commands, end_s: float) -> FloatArray | None:
    """Sizes of the steps between the places where a command stands [deg]; None if it mostly moves."""
    if commands.slope_deg_s.any():
        return None
    first = np.flatnonzero(np.diff(commands.command_deg, prepend=np.nan) != 0.0)
    times_s, levels_deg = commands.effective_s[first], commands.command_deg[first]
    lasts_s = np.diff(np.append(times_s, max(end_s, float(commands.effective_s[-1]))))
    stands = lasts_s > _HOLDS_S
    if float(lasts_s[stands].sum()) < _MOSTLY * float(lasts_s.sum()):
        return None
    sizes_deg: FloatArray = np.abs(np.diff(levels_deg[stands]))
    return sizes_deg
