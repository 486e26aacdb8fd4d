"""A value of an effect that goes with a condition of the runs: a rate limit that falls with the load.

The search fits it as a line over what was logged beside the runs. Here it is reported.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from servofd.core.types import FloatArray
from servofd.discrepancy.fit import LONG
from servofd.servo.catalogue import ALIKE, is_law, plain
from servofd.servo.effect import Effect

if TYPE_CHECKING:
    from servofd.discrepancy.select import Selection


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
    """Of each run, shape (r,)."""
    at_zero: float
    slope: float
    """Of the line through the values over the condition."""
    common_rms_deg: float
    """Error on data not fitted, of the servo with one value for all runs, fitted as well."""
    line_rms_deg: float
    """The same with the values of the line: that of the last step."""

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
            f"at {low:.4g}, {last:.4g} at {high:.4g}; with that, the error on data not fitted is "
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
            "values": self.values.tolist(),
            "common_rms_deg": self.common_rms_deg,
            "line_rms_deg": self.line_rms_deg,
        }


def varying(selection: Selection, conditions: Mapping[str, FloatArray]) -> tuple[Varying, ...]:
    """Values of the final effects that were found to go with a condition of the runs.

    `selection`: what was found in several runs; in a single one there is nothing to compare. `conditions` (shape (r,)):
    what was logged beside the servo, one number for each run, by the name of its channel.
    """
    return tuple(_law(selection, effect, conditions) for effect in selection.final.effects if is_law(effect))


def _law(selection: Selection, effect: type[Effect], known: Mapping[str, FloatArray]) -> Varying:
    """What an effect goes with."""
    record, physics = selection.fitter.record, selection.final.physics
    name, parameter = record.condition_names[int(physics.run_condition)], effect.parameters[0]
    of, value = known[name], getattr(physics, parameter.fields[0])
    slope = 2.0 * physics.run_slope / float(np.ptp(of))
    at_zero = value - physics.run_slope - slope * float(of.min())
    fitter, alike_in_all = selection.fitter, tuple(plain(each) for each in selection.final.effects)
    common = fitter.halved(fitter.descended(alike_in_all, physics._replace(run_slope=0.0), LONG))
    common_deg, line_deg = (float(np.sqrt(fit.held_out)) for fit in (common, selection.final))
    alike = [
        other for other, its in known.items()
        if other != name and np.ptp(its) > 0.0 and abs(np.corrcoef(its, of)[0, 1]) > ALIKE
    ]  # fmt: skip
    lines = at_zero, slope, common_deg, line_deg
    return Varying(effect.name, parameter.name, (name, *alike), of, at_zero + slope * of, *lines)
