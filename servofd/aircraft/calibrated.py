"""What a calibration writes into an aircraft file, beside what was there before: the fitted servo and its tests."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import ConfigDict, Field, model_validator

from servofd.aircraft.calibration import Entry
from servofd.aircraft.priors import NAMES, PRIORS
from servofd.core.toml_text import toml_key, toml_lines, toml_value
from servofd.core.types import FloatArray

Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
_LARGEST = 1e9
"""Larger variances in a calibration are no numbers of a servo."""
_BEYOND, _STANDING_M_S = 1.5, 6.0
"""Calibrated on the ground alone, 37 of 128 good flights of eight aircraft of even seed were at fault; beyond 1.5 times
the calibrated airspeed the air pushes more than twice as hard. A pitot reads so much where nothing moves."""
_UNKNOWN_AIR = 0.6
"""Dynamic pressure of flights of any style over that of a calibration flight: it differs between them by 0.49, and
within each by 0.3 more (standard deviations, aircraft of even seed in `benchmarks/strangers.py`)."""


class Learned(Entry):
    """Part of an aircraft file that calibration writes, whose numbers are finite."""

    model_config = ConfigDict(allow_inf_nan=False)


class Noise(Learned):
    """What the reading does beside the position: sigma^2 = still^2 + (lag * speed)^2, coloured as an AR(2) process."""

    still_deg: Positive
    lag_s: NotNegative
    colour: tuple[float, float]
    """Of neighbouring samples, each over its sigma."""
    innovation: Positive
    """Standard deviation of what is new in each sample, over sigma."""
    period_s: Positive
    """Time between samples that the colour belongs to."""

    @model_validator(mode="after")
    def _stable(self) -> Self:
        first, second = self.colour
        if not (abs(second) < 1.0 and abs(first) < 1.0 - second):
            raise ValueError(f"colour = [{first:g}, {second:g}] is no noise: it would grow for ever")
        return self

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
        new = {"colour": (pole, 0.0), "innovation": float(np.sqrt(1.0 - pole**2)), "period_s": period_s}
        return self.model_copy(update=new)


def lower_triangle(covariance: FloatArray) -> tuple[tuple[float, ...], ...]:
    """Rows of a symmetric matrix as a file keeps them, shape (n, n).

    Examples
    --------
    >>> lower_triangle(np.array([[4.0, 1.0], [1.0, 9.0]]))
    ((4.0,), (1.0, 9.0))
    """
    return tuple(tuple(float(f"{x:.5g}") for x in row[: i + 1]) for i, row in enumerate(covariance.tolist()))


def symmetric(rows: tuple[tuple[float, ...], ...]) -> FloatArray:
    """The matrix of such rows, shape (n, n)."""
    out = np.zeros((len(rows), len(rows)))
    for i, row in enumerate(rows):
        out[i, : i + 1] = out[: i + 1, i] = row
    return out


class Terms(Learned):
    """Parameters that were fitted to good flights, each by its name, and what flights differ by in that order."""

    NAMES: ClassVar[tuple[str, ...]]
    """Of all parameters, in order."""
    STRANGE: ClassVar[str]
    """What is said of the first name that is missing or unknown."""
    parameters: dict[str, float]
    between: tuple[tuple[float, ...], ...]
    """Covariance between good flights: lower triangle, row by row."""

    @model_validator(mode="after")
    def _complete(self) -> Self:
        wrong = sorted(set(self.NAMES) ^ set(self.parameters))
        if wrong:
            raise ValueError(self.STRANGE.format(wrong[0], "missing" if wrong[0] in self.NAMES else "unknown"))
        if [len(row) for row in self.between] != list(range(1, len(self.NAMES) + 1)):
            raise ValueError(f"between: the lower triangle of a matrix of {len(self.NAMES)} rows is needed")
        return self

    @property
    def theta(self) -> FloatArray:
        """Parameters in order, shape (n,)."""
        return np.array([self.parameters[name] for name in self.NAMES])

    @property
    def covariance(self) -> FloatArray:
        """Between good flights, shape (n, n)."""
        return symmetric(self.between)


class CalibratedServo(Terms):
    """A servo fitted to good flights, how far it may differ between them, and where each test alarms.

    Its parameters are those of `servofd.aircraft.priors.PRIORS`.
    """

    NAMES = NAMES
    STRANGE = (
        "parameters: {} is {}: this file was calibrated with other effects than this version knows; calibrate it again "
        "(servofd calibrate)"
    )
    noise: Noise
    reach_deg: tuple[float, float]
    """Deflections that the flights showed."""
    middle_deg: float = 0.0
    """Deflection about which the gain acts, and where the bias is that of the parameters: 0 but for a servo that never
    comes near it."""
    supply_v: NotNegative = 0.0
    """Usual supply; 0 where it was not logged."""
    airspeed_m_s: NotNegative | None = None
    """Usual airspeed; 0 where it was not logged, None where the file does not say."""
    fastest_m_s: NotNegative = 0.0
    """Largest airspeed of the good flights; 0 where it was not logged."""
    thresholds: dict[str, Positive] = {}
    """Of the statistics of `servofd.detection.changes`; those that are missing are the usual ones."""
    flights: Annotated[int, Field(ge=1)] = 1
    doubt: str = ""
    """What about it is like no sound servo, in words; then no flight of it is cleared."""

    @model_validator(mode="after")
    def _possible(self) -> Self:
        for prior in PRIORS:
            if not prior.low <= self.parameters[prior.name] <= prior.high:
                raise ValueError(f"parameters.{prior.name}: must lie between {prior.low:g} and {prior.high:g}")
        units = np.array([prior.between for prior in PRIORS])
        scaled = self.covariance / np.outer(units, units)
        if np.abs(self.covariance).max() > _LARGEST or np.linalg.eigvalsh(scaled)[0] <= 0.0:
            raise ValueError("between: not a covariance, as it is not positive definite")
        if not self.reach_deg[0] < self.reach_deg[1]:
            raise ValueError("reach_deg = [lower, upper] needs lower < upper")
        return self

    @property
    def offset_deg(self) -> float:
        """Position at a command of 0 [deg]."""
        return self.parameters["bias_deg"] + self.middle_deg * (1.0 - self.parameters["gain"])

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


def terms_to_toml(heading: str, known: Mapping[str, Any], comments: Mapping[str, str]) -> list[str]:
    """Lines of an aircraft file that hold fitted terms (as their `model_dump` gives them), with comments on them.

    Examples
    --------
    >>> known = {"parameters": {"gain": 1.0}, "between": [[1.0]], "reach_deg": [-20.0, 20.0], "noise": {"lag_s": 0.003}}
    >>> terms_to_toml("surfaces.rudder.calibrated", known, {})[:3]
    ['', '[surfaces.rudder.calibrated]', 'reach_deg = [-20.0, 20.0]']
    """
    inner = {key: part for key, part in known.items() if isinstance(part, dict)}
    plain = {key: part for key, part in known.items() if key not in (*inner, "between")}
    lines = ["", f"[{heading}]", *toml_lines(plain), "between = [  # covariance between good flights, lower triangle"]
    lines += [*(f"    {toml_value(row)}," for row in known["between"]), "]"]
    for key, part in inner.items():
        if part:
            lines += ["", f"[{heading}.{key}]", *toml_lines(part, comments if key == "parameters" else {})]
    return lines


def calibrated_to_toml(name: str, known: Mapping[str, Any], comments: Mapping[str, str]) -> list[str]:
    """Lines of an aircraft file that hold a fitted servo, with the unit of each parameter behind its comment."""
    parameters = {prior.name: known["parameters"][prior.name] for prior in PRIORS}
    comments = {prior.name: f"{comments.get(prior.name, '')} {prior.unit}".strip() for prior in PRIORS}
    return terms_to_toml(f"surfaces.{toml_key(name)}.calibrated", {**known, "parameters": parameters}, comments)
