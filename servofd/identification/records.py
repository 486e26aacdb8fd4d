"""Records of bench tests: several runs with one servo, several servos of one kind."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from logparsers.units import MS_PER_S
from servofd.core.errors import IdentificationError
from servofd.core.series import latest
from servofd.core.statistics import LEAST_DIVISOR
from servofd.core.types import FloatArray

if TYPE_CHECKING:
    from servofd.aircraft.series import Series

_FAR_AWAY_S = 60.0
"""The servo rests for so long before a run that nothing is left of how it came there."""
_STEP_SHARE = 0.1
"""Of the range of a run: a position further from the first command than this, apart from the offset of the whole run,
was asked for by an earlier one."""
_GAP_PERIODS = 10.0
"""Median periods beyond which a record is two."""
_REGULAR = 0.01
"""Of a period: stamps that differ by less are those of a regular clock, rounded."""


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """One test with one servo, prepared for simulation.

    `servo`: which servo of several; runs of one servo share their offset. `command_s`, `command_deg` (shape (n,)):
    commands that hold until the next, the first long before the test [s], [deg]. `measured_s`, `measured_deg` (shape
    (m,)): position, without missing values.
    """

    servo: int
    command_s: FloatArray
    command_deg: FloatArray
    measured_s: FloatArray
    measured_deg: FloatArray

    @property
    def span_deg(self) -> float:
        """Range of the command or of the position, whichever is larger [deg]."""
        return max(float(np.ptp(self.command_deg)), float(np.ptp(self.measured_deg)))


@dataclass(frozen=True, slots=True, eq=False)
class Uniform:
    """The same test on uniform time stamps, for the frequency response only."""

    command_deg: FloatArray
    measured_deg: FloatArray
    sample_time_s: float
    resampled: bool
    """True if the stamps were not uniform already: positions were interpolated, commands held."""


def prepared(segment: Series, servo: int = 0) -> Run:
    """Prepare a segment: rest before it, no missing values."""
    known = np.isfinite(segment.measured_deg)
    measured_s, measured_deg = segment.measured_s[known], segment.measured_deg[known]
    first_deg, rest_deg = float(segment.command_deg[0]), float(np.median(measured_deg[:3]))
    span_deg = max(float(np.ptp(segment.command_deg)), float(np.ptp(measured_deg)))
    offset_deg = float(np.mean(measured_deg) - np.mean(segment.command_deg))
    if abs(rest_deg - first_deg - offset_deg) <= _STEP_SHARE * span_deg:
        rest_deg = first_deg
    begin_s = min(float(segment.command_s[0]), float(measured_s[0])) - _FAR_AWAY_S
    return Run(
        servo, np.append(begin_s, segment.command_s), np.append(rest_deg, segment.command_deg), measured_s, measured_deg
    )


def longest_uniform(run: Run) -> Uniform:
    """Longest stretch without a gap, on uniform stamps at the pace of the commands or the measurements.

    Positions between two stamps are interpolated, commands held, if the stamps are not uniform already.
    """
    steps_s = np.diff(run.measured_s)
    period_s = float(np.median(steps_s))
    if run.command_s.size > 3:
        period_s = min(period_s, float(np.median(np.diff(run.command_s[1:]))))
    ends = np.concatenate([[0], np.flatnonzero(steps_s > _GAP_PERIODS * np.median(steps_s)) + 1, [run.measured_s.size]])
    longest = int(np.argmax(np.diff(ends)))
    stretch = slice(ends[longest], ends[longest + 1])
    measured_s, measured_deg = run.measured_s[stretch], run.measured_deg[stretch]
    regular = bool(
        np.array_equal(run.measured_s, run.command_s[1:])
        and np.all(np.abs(np.diff(measured_s) - period_s) <= _REGULAR * period_s)
    )
    grid_s = measured_s
    if not regular:
        grid_s = measured_s[0] + period_s * np.arange(int((measured_s[-1] - measured_s[0]) / period_s) + 1)
        measured_deg = np.interp(grid_s, measured_s, measured_deg)
    return Uniform(latest(run.command_s, run.command_deg, grid_s + 1e-9), measured_deg, period_s, not regular)


_SLOWEST_HZ, _FASTEST_HZ = 8.0, 20_000.0
"""Rates that show a servo [Hz]."""
_FEWEST_SAMPLES = 30
"""Positions that a record needs."""
_CLIPPED_SAMPLES, _CLIPPED_COMMAND = 0.05, 0.15
"""Share of the samples at an end, and change of the command meanwhile as a share of its range, from which on the
position is clipped."""
_LEAD_S = 0.01
"""Time by which a position ahead of its command is refused [s]."""
DRIFT_SHARE, _DRIFT_OF_ERROR = 0.2, 0.9
"""Of the range of the command, over the test; and of the squared error of the best linear servo."""


def check_segment(segment: Series, label: str) -> None:
    """Refuse a record that is too short, sampled wrongly, or without excitation."""
    known = np.isfinite(segment.measured_deg)
    count = int(np.count_nonzero(known))
    if count < _FEWEST_SAMPLES:
        raise IdentificationError(
            f"{label}: only {count} measured positions; a chirp or steps with at least {_FEWEST_SAMPLES} are needed"
        )
    rate_hz = 1.0 / segment.period_s
    if not _SLOWEST_HZ <= rate_hz <= _FASTEST_HZ:
        unit = "milliseconds" if rate_hz < _SLOWEST_HZ else "seconds"
        raise IdentificationError(
            f"{label}: sampled at {rate_hz:.4g} Hz: too {'slow' if rate_hz < _SLOWEST_HZ else 'fast'} to see a servo; "
            f"{_SLOWEST_HZ:g} Hz to {_FASTEST_HZ:g} Hz work. Are the time stamps in {unit}?"
        )
    measured = segment.measured_deg[known]
    at_start = float(np.median(measured[:3]))
    if np.ptp(segment.command_deg) == 0.0 and abs(segment.command_deg[0] - at_start) < 0.5 * float(np.ptp(measured)):
        raise IdentificationError(
            f"{label}: no excitation: the command is {segment.command_deg[0]:g} deg throughout; "
            "command a chirp (1 to 25 Hz, 4 deg, 120 s) or steps"
        )


def check_clipping(run: Run, label: str) -> None:
    """Refuse a position that stays at its extreme while the command moves on."""
    command_deg = latest(run.command_s, run.command_deg, run.measured_s)
    for extreme in (run.measured_deg.max(), run.measured_deg.min()):
        held = run.measured_deg == extreme
        if np.mean(held) < _CLIPPED_SAMPLES:
            continue
        low, high = np.quantile(command_deg[held], (0.1, 0.9))
        if high - low > _CLIPPED_COMMAND * np.ptp(command_deg):
            raise IdentificationError(
                f"{label}: position is clipped: {np.mean(held):.0%} of the samples are exactly {extreme:g} deg while "
                f"the command moves by {high - low:.3g} deg; use a smaller amplitude or a sensor with more range"
            )


def check_drift(run: Run, error_deg: FloatArray, label: str) -> None:
    """Refuse a position that wanders off while the command does not: it would pass for rate limits."""
    drifts_deg = drift_deg(run.measured_s, error_deg, latest(run.command_s, run.command_deg, run.measured_s))
    if abs(drifts_deg) > DRIFT_SHARE * np.ptp(run.command_deg):
        raise IdentificationError(
            f"{label}: the position drifts by {drifts_deg:.3g} deg over the test while the command does not: a sensor "
            "that wanders or slips; repeat the test, or take the trend out"
        )


def drift_deg(time_s: FloatArray, error_deg: FloatArray, command_deg: FloatArray) -> float:
    """By how much an error rises along a line over the record [deg]; 0 where less than most of it is that line.

    What of it follows the command is another gain, and no drift, where the command rises as well.

    Examples
    --------
    >>> time_s, swings = np.arange(10.0), np.array([0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0])
    >>> round(drift_deg(time_s, 0.5 * time_s, swings), 6)
    4.5
    >>> drift_deg(time_s, swings, swings), drift_deg(time_s, -0.3 * time_s, time_s)
    (0.0, 0.0)
    """
    since = (time_s - time_s.mean()) / np.ptp(time_s)
    swing_deg = command_deg - command_deg.mean()
    error_deg = error_deg - error_deg.mean()
    error_deg = error_deg - float(swing_deg @ error_deg / max(float(swing_deg @ swing_deg), LEAST_DIVISOR)) * swing_deg
    drifts_deg = float(since @ error_deg / (since @ since))
    explained = drifts_deg**2 * float(since @ since) / max(float(error_deg @ error_deg), LEAST_DIVISOR)
    return drifts_deg if explained > _DRIFT_OF_ERROR else 0.0


def check_order_of_columns(uniform: Uniform, label: str) -> None:
    """Refuse a position that moves before its command."""
    from scipy.signal import correlate, correlation_lags

    command_deg, measured_deg, sample_time_s = uniform.command_deg, uniform.measured_deg, uniform.sample_time_s
    lag = correlation_lags(command_deg.size, command_deg.size)
    near = np.abs(lag) * sample_time_s <= 1.0
    product = correlate(np.diff(measured_deg, prepend=measured_deg[0]), np.diff(command_deg, prepend=command_deg[0]))
    lead_s = -float(lag[near][np.argmax(np.abs(product[near]))]) * sample_time_s
    if lead_s >= max(_LEAD_S, 1.5 * sample_time_s):
        raise IdentificationError(
            f"{label}: the position moves {MS_PER_S * lead_s:.0f} ms before the command: are the two columns swapped?"
        )
