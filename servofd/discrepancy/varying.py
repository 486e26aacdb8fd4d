"""A value of an effect that differs from run to run, and what it goes with: a rate limit that falls with the load.

Each run has its own best value, the others being common to all. A line through those of the fitted runs over something
that was logged beside them is then held against the runs that were held out: it is reported only if it predicts them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from servofd.core.fitting import Noise, Problem, fit
from servofd.discrepancy.noise import long_run_factor
from servofd.discrepancy.record import simulate
from servofd.servo.catalogue import ALIKE, FEWEST_RUNS, is_law, law_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from servofd.core.types import BoolArray, FloatArray
    from servofd.discrepancy.record import Record
    from servofd.discrepancy.select import Selection
    from servofd.servo.effect import Effect, Parameter

_LEAST_SHARE, _SIGMAS = 0.5, 3.0
"""Of the value that is common to all runs, the least that a run may have, and the inverse of the most; a run tells its
own if it is so many standard deviations from both."""
_STEP_SHARE, _STEPS = 0.02, 15
"""Step of the derivatives as a share of the common value, and steps of the fit at most."""
_LEAST_DETERMINED, _LEAST_GAIN = 0.7, 0.8
"""Share of the spread of the values that the line tells, and of the error of held-out runs that it may leave."""
_LEAST_CHANGE = 0.05
"""Of the value, from one end of the runs to the other: less is what servos of one kind differ by."""


@dataclass(frozen=True, slots=True, eq=False)
class Varying:
    """A value that goes with a condition."""

    effect: str
    parameter: str
    conditions: tuple[str, ...]
    """The one that tells most of it, then those that vary with it."""
    condition: FloatArray
    """In each run, shape (r,)."""
    values: FloatArray
    """Of each run, shape (r,); NaN where it does not show."""
    at_zero: float
    slope: float
    """Of the line through the values over the condition."""
    common_rms_deg: float
    """Error of the held-out runs with one value for all."""
    line_rms_deg: float
    """The same with the values of the line."""

    @property
    def ends(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Lowest and highest condition, each with the line's value there."""
        low, high = float(self.condition.min()), float(self.condition.max())
        return (low, self.at_zero + self.slope * low), (high, self.at_zero + self.slope * high)

    @property
    def sentence(self) -> str:
        """In words."""
        (low, first), (high, last) = self.ends
        others = f" (or {', '.join(self.conditions[1:])}, which varies with it)" if len(self.conditions) > 1 else ""
        return (
            f"{self.parameter} {'falls' if last < first else 'rises'} with {self.conditions[0]}{others}: {first:.4g} "
            f"at {low:.4g}, {last:.4g} at {high:.4g}; with that, the error of the runs held out is "
            f"{self.line_rms_deg:.3g} instead of {self.common_rms_deg:.3g} deg rms"
        )

    def document(self) -> dict[str, object]:
        """Plain dictionary."""
        return {
            "effect": self.effect,
            "parameter": self.parameter,
            "conditions": list(self.conditions),
            "at_zero": self.at_zero,
            "slope": self.slope,
            "values": [float(value) if np.isfinite(value) else None for value in self.values],
            "common_rms_deg": self.common_rms_deg,
            "line_rms_deg": self.line_rms_deg,
        }


def varying(selection: Selection, conditions: Mapping[str, FloatArray]) -> tuple[Varying, ...]:
    """Find values of the final effects that go with a condition of the runs.

    Parameters
    ----------
    selection : Selection
        What was found in several runs; in a single one there is nothing to compare.
    conditions : mapping of str to ndarray, shape (r,)
        What was logged beside the servo, one number for each run, by the name of its channel.

    Returns
    -------
    tuple of Varying
        The laws that were found as such, and for each other value at most the condition that tells most of it; the
        one that predicts the held-out runs best first.
    """
    record, final = selection.fitter.record, selection.final
    known = {name: of for name, of in conditions.items() if np.all(np.isfinite(of)) and np.ptp(of) > 0.0}
    if not known or not record.runs:
        return ()
    held_out = _held_out(record)
    found = []
    names = [(effect, parameter) for effect in final.effects for parameter in effect.parameters]
    for k, (effect, parameter) in enumerate(names):
        if parameter.kinked or parameter.aside:
            continue
        values = np.array([_own_value(selection, run, k, parameter) for run in record.runs])
        shown = np.isfinite(values)
        if is_law(effect) and parameter is effect.parameters[0]:
            found += _law(selection, k, effect, known, values)
            continue
        fitted = shown & ~held_out
        if np.count_nonzero(fitted) < FEWEST_RUNS or not np.any(shown & held_out):
            continue
        determined = {name: _determined(of[fitted], values[fitted]) for name, of in known.items()}
        best = max(determined, key=lambda name: determined[name])
        if determined[best] < _LEAST_DETERMINED:
            continue
        slope, at_zero = np.polyfit(known[best][fitted], values[fitted], 1).tolist()
        line = at_zero + slope * known[best]
        common_deg, line_deg = (
            _rms_deg(selection, k, np.where(shown, each, final.values[k]), held_out)
            for each in (np.full(values.size, final.values[k]), line)
        )
        if np.ptp(line) < _LEAST_CHANGE * abs(final.values[k]) or line_deg > _LEAST_GAIN * common_deg:
            continue
        alike = [n for n in known if n != best and abs(np.corrcoef(known[n], known[best])[0, 1]) > ALIKE]
        lines = at_zero, slope, common_deg, line_deg
        found.append(Varying(effect.name, parameter.name, (best, *alike), known[best], values, *lines))
    return tuple(sorted(found, key=lambda each: each.line_rms_deg))


def _law(
    selection: Selection, index: int, effect: type[Effect], known: Mapping[str, FloatArray], values: FloatArray
) -> list[Varying]:
    """What an effect goes with that was found with its law: no line has to be drawn any more."""
    record, physics = selection.fitter.record, selection.final.physics
    name = record.condition_names[int(physics.run_condition)]
    if name not in known:
        return []
    of, value = known[name], float(selection.final.values[index])
    slope = 2.0 * physics.run_slope / float(np.ptp(of))
    at_zero = value - physics.run_slope - slope * float(of.min())
    held_out = _held_out(record)
    common_deg, line_deg = (
        _rms_deg(selection, index, each, held_out) for each in (np.full(of.size, value), at_zero + slope * of)
    )
    alike = [n for n in known if n != name and abs(np.corrcoef(known[n], of)[0, 1]) > ALIKE]
    parameter = effect.parameters[0].name
    return [Varying(effect.name, parameter, (name, *alike), of, values, at_zero, slope, common_deg, line_deg)]


def _held_out(record: Record) -> BoolArray:
    """Which of the runs were not fitted, shape (r,)."""
    ends = np.cumsum([each.time_s.size for each in record.runs])
    held_out: BoolArray = record.fold[ends - 1] != 0
    return held_out


def _error_deg(selection: Selection, run: Record, index: int, value: float) -> FloatArray:
    """Of one run, with one of the final values in another's place, where it counts."""
    fields, physics = selection.final.parameters[index].fields, selection.final.physics
    if physics.run_slope and fields == law_of(physics).fields:
        physics = physics._replace(run_slope=0.0)
    simulated_deg = simulate(run, physics._replace(**dict.fromkeys(fields, value)))
    error_deg: FloatArray = (run.measured_deg - simulated_deg)[run.counts]
    return error_deg


def _own_value(selection: Selection, run: Record, index: int, parameter: Parameter) -> float:
    """Best for one run; NaN where the run does not tell it from half and from twice the common value."""
    common = float(selection.final.values[index])
    ends = sorted((_LEAST_SHARE * common, common / _LEAST_SHARE))
    low, high = max(ends[0], parameter.low), min(ends[1], parameter.high)
    step = _STEP_SHARE * abs(common)
    if not low + step < high:
        return float("nan")

    def error_deg(x: FloatArray) -> FloatArray:
        return _error_deg(selection, run, index, float(x[0]))

    bounds = np.array([low]), np.array([high])
    found = fit(Problem.free(error_deg, bounds, Noise(), step), np.array([common]), steps=_STEPS)
    value = float(found.x[0])
    surely = _SIGMAS * float(np.sqrt(found.covariance(long_run_factor(found.error))[0, 0]))
    return value if value - low > surely and high - value > surely else float("nan")


def _determined(condition: FloatArray, values: FloatArray) -> float:
    """Share of the spread of values that a line over a condition tells."""
    if np.ptp(condition) == 0.0 or np.ptp(values) == 0.0:
        return 0.0
    return float(np.corrcoef(condition, values)[0, 1] ** 2)


def _rms_deg(selection: Selection, index: int, values: FloatArray, held_out: BoolArray) -> float:
    """Error of the held-out runs, each with a value of its own [deg rms]."""
    runs = selection.fitter.record.runs
    errors = [_error_deg(selection, runs[k], index, float(values[k])) for k in np.flatnonzero(held_out)]
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))
