"""From what a log holds (radians, pulse widths, counts) to degrees of surface deflection."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from servofd.core.errors import ConfigError
from servofd.core.types import FloatArray

Finite = Annotated[float, Field(allow_inf_nan=False, strict=True)]
Cubic = tuple[Finite, Finite, Finite, Finite]

_LARGEST_ANGLE_RAD = 2.0 * np.pi


class Entry(BaseModel):
    """Part of an aircraft file, which has no keys but its own."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class _Channel(Entry):
    """One channel of a log, and the sign that makes positive mean trailing edge down (rudder: left).

    A straight line through the trim; or a cubic (`cubic_deg`, if it has that field) where the linkage needs one.
    """

    trim_key: ClassVar[str]
    slope_key: ClassVar[str] = ""
    """Empty where the unit tells the slope, `unit_deg`."""
    unit_deg: ClassVar[float] = 1.0
    channel: str = ""
    """Empty only for a surface that names its output instead."""
    sign: Literal[1, -1] = 1
    correction: tuple[Finite, Finite] = (1.0, 0.0)
    """Scale and offset [deg], found by calibration, that turn what is said below into degrees of the command."""

    @model_validator(mode="after")
    def _invertible(self) -> Self:
        if self.correction[0] == 0.0:
            raise ValueError("correction = [scale, offset_deg] needs a scale that is not zero")
        if hasattr(self, "cubic_deg") and ((self._slope is None) == (self._cubic is None) or self._slope == 0.0):
            raise ValueError(f"give either {self.slope_key} (not zero) or cubic_deg = [c0, c1, c2, c3]")
        return self

    def to_deg(self, values: FloatArray) -> FloatArray:
        """Deflection [deg], same shape as `values` [as logged]."""
        scale, offset_deg = self.correction
        with np.errstate(over="ignore"):  # what is too large for a number is none
            return scale * self.plain_deg(values) + offset_deg

    def plain_deg(self, values: FloatArray) -> FloatArray:
        """Deflection before the correction [deg]."""
        with np.errstate(over="ignore"):
            return self._convert(values)

    def from_deg(self, deflection_deg: FloatArray) -> FloatArray:
        """Logged value of a deflection [deg]."""
        scale, offset_deg = self.correction
        return self._restore((np.asarray(deflection_deg) - offset_deg) / scale)

    def corrected(self, scale: float, offset_deg: float) -> Self:
        """Return the same calibration with its result scaled, then shifted [deg]."""
        first, shift_deg = self.correction
        return self.model_copy(update={"correction": (scale * first, scale * shift_deg + offset_deg)})

    @property
    def _cubic(self) -> Cubic | None:
        return getattr(self, "cubic_deg", None)

    @property
    def _slope(self) -> float | None:
        return getattr(self, self.slope_key) if self.slope_key else self.unit_deg

    def _convert(self, values: FloatArray) -> FloatArray:
        if self._cubic is not None:
            return self.sign * np.polyval(np.array(self._cubic[::-1]), values)
        line: FloatArray = self.sign * (self._slope or 0.0) * (values - getattr(self, self.trim_key))
        return line

    def _restore(self, deflection_deg: FloatArray) -> FloatArray:
        if self._slope is None:
            raise ConfigError(f"channel {self.channel!r}: a cubic calibration cannot be written back to a log")
        logged: FloatArray = self.sign * deflection_deg / self._slope + getattr(self, self.trim_key)
        return logged


class DegreeCalibration(_Channel):
    """A channel in degrees: ``deflection = sign * (value - trim_deg)``.

    Examples
    --------
    >>> DegreeCalibration(channel="elevator_pos_deg", unit="deg", trim_deg=0.5).to_deg(np.array([1.5]))
    array([1.])
    """

    trim_key = "trim_deg"
    unit: Literal["deg"]
    trim_deg: Finite = 0.0
    pulse: tuple[Finite, Finite] | None = None
    """Where a log has pulses only: the pulse of 0 deg [us], and degrees of this channel for each microsecond."""


class RadianCalibration(_Channel):
    """A channel in radians: ``deflection = sign * degrees(value - trim_rad)``."""

    trim_key, unit_deg = "trim_rad", float(np.degrees(1.0))
    unit: Literal["rad"]
    trim_rad: Finite = 0.0

    def _restore(self, deflection_deg: FloatArray) -> FloatArray:
        return self.sign * np.radians(deflection_deg) + self.trim_rad


class PulseCalibration(_Channel):
    """A pulse width: ``deflection = sign * slope_deg_per_us * (value - trim_us)``, or a cubic in it.

    Examples
    --------
    >>> pulse = PulseCalibration(channel="pwm", unit="us", trim_us=1500.0, slope_deg_per_us=0.1)
    >>> pulse.to_deg(np.array([1600.0]))
    array([10.])
    """

    trim_key, slope_key = "trim_us", "slope_deg_per_us"
    unit: Literal["us"]
    trim_us: Finite = 1500.0
    slope_deg_per_us: Finite | None = None
    cubic_deg: Cubic | None = None

    def _convert(self, values: FloatArray) -> FloatArray:
        # A pulse that was not sent is logged as 0.
        return super()._convert(np.where(values > 0.0, values, np.nan))


class CountCalibration(_Channel):
    """Converter or timer counts: ``deflection = sign * slope_deg_per_count * (value - trim_count)``, or a cubic."""

    trim_key, slope_key = "trim_count", "slope_deg_per_count"
    unit: Literal["count"]
    trim_count: Finite = 0.0
    slope_deg_per_count: Finite | None = None
    cubic_deg: Cubic | None = None


class NormCalibration(_Channel):
    """A command from -1 to 1: ``deflection = sign * slope_deg * (value - trim)``.

    Examples
    --------
    >>> NormCalibration(channel="control[0]", unit="norm", slope_deg=25.0).to_deg(np.array([-1.0, 0.5]))
    array([-25. ,  12.5])
    """

    trim_key, slope_key = "trim", "slope_deg"
    unit: Literal["norm"]
    trim: Finite = 0.0
    slope_deg: Finite


class RadianOrCountCalibration(_Channel):
    """The FASER position columns: documented in radians, written as raw converter counts.

    Values that mostly lie beyond any angle in radians are counts; everything else is taken as radians.
    """

    trim_key, slope_key = "trim_count", "slope_deg_per_count"
    unit: Literal["rad_or_count"]
    trim_count: Finite
    slope_deg_per_count: Finite

    def _convert(self, values: FloatArray) -> FloatArray:
        finite = values[np.isfinite(values)]
        if finite.size and np.median(np.abs(finite)) > _LARGEST_ANGLE_RAD:
            return super()._convert(values)
        return self.sign * np.degrees(values)

    def _restore(self, deflection_deg: FloatArray) -> FloatArray:
        # A converter gives whole numbers.
        return np.round(super()._restore(deflection_deg))


Calibration = Annotated[
    DegreeCalibration
    | RadianCalibration
    | PulseCalibration
    | CountCalibration
    | NormCalibration
    | RadianOrCountCalibration,
    Field(discriminator="unit"),
]
