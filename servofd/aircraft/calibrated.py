"""What a calibration writes into an aircraft file, beside what was there before: the fitted servo and its tests."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from servofd.aircraft.calibration import Entry
from servofd.aircraft.priors import NAMES, PRIORS
from servofd.core.toml_text import toml_key, toml_lines, toml_value
from servofd.core.types import FloatArray

_Finite = Annotated[float, Field(allow_inf_nan=False)]
_Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
_LARGEST = 1e9
"""Larger variances in a calibration are no numbers of a servo."""
_BEYOND, _STANDING_M_S = 1.5, 6.0
"""Calibrated on the ground alone, 37 of 128 good flights of eight aircraft of even seed were at fault; beyond 1.5 times
the calibrated airspeed the air pushes more than twice as hard. A pitot reads so much where nothing moves."""
_UNKNOWN_AIR = 0.6
"""Dynamic pressure of flights of any style over that of a calibration flight: it differs between them by 0.49, and
within each by 0.3 more (standard deviations, aircraft of even seed in `benchmarks/strangers.py`)."""


@dataclass(frozen=True, slots=True)
class Noise:
    """What the reading does beside the position: sigma^2 = still^2 + (lag * speed)^2, coloured as an AR(2) process."""

    still_deg: float
    lag_s: float
    colour: tuple[float, float]
    """Of neighbouring samples, each over its sigma."""
    innovation: float
    """Standard deviation of what is new in each sample, over sigma."""
    period_s: float
    """Time between samples that the colour belongs to."""

    def sigma_deg(self, speed_deg_s: FloatArray) -> FloatArray:
        """Standard deviation at some largest speeds [deg]."""
        return np.sqrt(self.still_deg**2 + (self.lag_s * speed_deg_s) ** 2)

    def at(self, period_s: float) -> Noise:
        """The same noise, sampled at another rate."""
        ratio = period_s / self.period_s
        if 1 / 1.3 < ratio < 1.3:
            return self
        first, second = self.colour
        near = first / (1.0 - second)
        pole = float(np.clip(max(near, 0.0) ** ratio, 0.0, 0.95))
        return Noise(self.still_deg, self.lag_s, (pole, 0.0), float(np.sqrt(1.0 - pole**2)), period_s)


class CalibratedNoise(Entry):
    """Noise of the reading: ``sigma^2 = still_deg^2 + (lag_s * speed)^2``, coloured."""

    still_deg: _Positive
    lag_s: Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
    colour: tuple[_Finite, _Finite]
    innovation: _Positive
    period_s: _Positive

    @model_validator(mode="after")
    def _stable(self) -> Self:
        first, second = self.colour
        if not (abs(second) < 1.0 and abs(first) < 1.0 - second):
            raise ValueError(f"colour = [{first:g}, {second:g}] is no noise: it would grow for ever")
        return self

    @property
    def noise(self) -> Noise:
        """The same, ready for tests."""
        return Noise(self.still_deg, self.lag_s, self.colour, self.innovation, self.period_s)


def lower_triangle(covariance: FloatArray) -> tuple[tuple[float, ...], ...]:
    """Rows of a symmetric matrix as a file keeps them, shape (n, n).

    Examples
    --------
    >>> lower_triangle(np.array([[4.0, 1.0], [1.0, 9.0]]))
    ((4.0,), (1.0, 9.0))
    """
    return tuple(tuple(float(f"{x:.5g}") for x in row[: i + 1]) for i, row in enumerate(covariance.tolist()))


def symmetric(rows: tuple[tuple[float, ...], ...]) -> FloatArray:
    """The matrix of such rows, shape (n, n).

    Examples
    --------
    >>> symmetric(((4.0,), (1.0, 9.0)))
    array([[4., 1.],
           [1., 9.]])
    """
    out = np.zeros((len(rows), len(rows)))
    for i, row in enumerate(rows):
        out[i, : i + 1] = out[: i + 1, i] = row
    return out


class CalibratedServo(BaseModel):
    """A servo fitted to good flights, how far it may differ between them, and where each test alarms."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    parameters: dict[str, _Finite]
    """Of `servofd.aircraft.priors.PRIORS`, all of them."""
    between: tuple[tuple[_Finite, ...], ...]
    """Covariance between good flights, in the order of the priors: lower triangle, row by row."""
    noise: CalibratedNoise
    reach_deg: tuple[_Finite, _Finite]
    """Deflections that the flights showed."""
    middle_deg: _Finite = 0.0
    """Deflection about which the gain acts, and where the bias is that of the parameters: 0 but for a servo that never
    comes near it."""
    supply_v: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] = 0.0
    """Usual supply; 0 where it was not logged."""
    airspeed_m_s: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] | None = None
    """Usual airspeed; 0 where it was not logged, None where the file does not say."""
    fastest_m_s: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] = 0.0
    """Largest airspeed of the good flights; 0 where it was not logged."""
    thresholds: dict[str, _Positive] = {}
    """Of the statistics of `servofd.detection.changes`; those that are missing are the usual ones."""
    flights: Annotated[int, Field(ge=1)] = 1
    doubt: str = ""
    """What about it is like no sound servo, in words; then no flight of it is cleared."""

    @model_validator(mode="after")
    def _complete(self) -> Self:
        wrong = sorted(set(NAMES) ^ set(self.parameters))
        if wrong:
            raise ValueError(
                f"parameters: {wrong[0]} is {'missing' if wrong[0] in NAMES else 'unknown'}: this file was calibrated "
                "with other effects than this version knows; calibrate it again (servofd calibrate)"
            )
        for prior in PRIORS:
            if not prior.low <= self.parameters[prior.name] <= prior.high:
                raise ValueError(f"parameters.{prior.name}: must lie between {prior.low:g} and {prior.high:g}")
        if [len(row) for row in self.between] != list(range(1, len(NAMES) + 1)):
            raise ValueError(f"between: the lower triangle of a matrix of {len(NAMES)} rows is needed")
        if np.abs(self.covariance).max() > _LARGEST or np.linalg.eigvalsh(self._scaled)[0] <= 0.0:
            raise ValueError("between: not a covariance, as it is not positive definite")
        if not self.reach_deg[0] < self.reach_deg[1]:
            raise ValueError("reach_deg = [lower, upper] needs lower < upper")
        return self

    @property
    def theta(self) -> FloatArray:
        """Parameters in order, shape (13,)."""
        return np.array([self.parameters[name] for name in NAMES])

    @property
    def offset_deg(self) -> float:
        """Position at a command of 0 [deg]."""
        return self.parameters["bias_deg"] + self.middle_deg * (1.0 - self.parameters["gain"])

    @property
    def covariance(self) -> FloatArray:
        """Between good flights, shape (parameters, parameters)."""
        return symmetric(self.between)

    def without_airspeed(self) -> Self:
        """The same servo in a flight that logged no airspeed: how hard the air pushes is a guess."""
        if not self.airspeed_m_s:
            return self
        pushed = np.where(np.char.startswith(NAMES, "hinge"), self.theta, 0.0)
        wider = self.covariance + _UNKNOWN_AIR**2 * np.outer(pushed, pushed)
        return self.model_copy(update={"between": lower_triangle(wider)})

    @property
    def last_judged_m_s(self) -> float:
        """Airspeed up to which the effect of the air on the servo is known; infinite where none was logged."""
        return _BEYOND * max(self.fastest_m_s, _STANDING_M_S) if self.fastest_m_s else np.inf

    @property
    def _scaled(self) -> FloatArray:
        units = np.array([prior.between for prior in PRIORS])
        return self.covariance / np.outer(units, units)


def calibrated_to_toml(name: str, known: dict[str, Any], comments: Mapping[str, str]) -> list[str]:
    """Lines of an aircraft file that hold a fitted servo (as `CalibratedServo.model_dump` gives it) and its tests.

    Examples
    --------
    >>> parameters = {prior.name: prior.value for prior in PRIORS}
    >>> known = {"reach_deg": [-20.0, 20.0], "parameters": parameters, "between": [[1.0]], "noise": {"lag_s": 0.003}}
    >>> calibrated_to_toml("rudder", known, {})[:3]
    ['', '[surfaces.rudder.calibrated]', 'reach_deg = [-20.0, 20.0]']
    """
    heading = f"surfaces.{toml_key(name)}.calibrated"
    plain = {key: value for key, value in known.items() if key not in ("parameters", "thresholds", "between", "noise")}
    lines = ["", f"[{heading}]", *toml_lines(plain), "between = [  # covariance between good flights, lower triangle"]
    lines += [f"    {toml_value(row)}," for row in known["between"]]
    lines += ["]", "", f"[{heading}.parameters]"]
    comments_of = {prior.name: f"{comments.get(prior.name, '')} {prior.unit}".strip() for prior in PRIORS}
    lines += toml_lines({prior.name: known["parameters"][prior.name] for prior in PRIORS}, comments_of)
    lines += ["", f"[{heading}.noise]", *toml_lines(known["noise"])]
    if known.get("thresholds"):
        lines += ["", f"[{heading}.thresholds]", *toml_lines(known["thresholds"])]
    return lines
