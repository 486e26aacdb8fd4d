"""From what a log holds (radians, pulse widths, counts) to degrees of surface deflection."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from servofd.core.errors import ConfigError
from servofd.core.types import FloatArray

Finite = Annotated[float, Field(allow_inf_nan=False, strict=True)]
Cubic = tuple[Finite, Finite, Finite, Finite]

_LARGEST_ANGLE_RAD = 2.0 * np.pi


class _Channel(BaseModel, ABC):
    """One channel of a log, and the sign that makes positive mean trailing edge down (rudder: left)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    channel: str = ""
    """Empty only for a surface that names its output instead."""
    sign: Literal[1, -1] = 1
    correction: tuple[Finite, Finite] = (1.0, 0.0)
    """Scale and offset [deg], found by calibration, that turn what is said below into degrees of the command."""

    @model_validator(mode="after")
    def _invertible(self) -> Self:
        if self.correction[0] == 0.0:
            raise ValueError("correction = [scale, offset_deg] needs a scale that is not zero")
        return self

    def to_deg(self, values: FloatArray) -> FloatArray:
        """Deflection [deg], same shape as `values` [as logged]."""
        scale, offset_deg = self.correction
        with np.errstate(over="ignore"):  # what is too large for a number is none
            return scale * self._convert(values) + offset_deg

    def from_deg(self, deflection_deg: FloatArray) -> FloatArray:
        """Logged value of a deflection [deg]."""
        scale, offset_deg = self.correction
        return self._restore((np.asarray(deflection_deg) - offset_deg) / scale)

    def corrected(self, scale: float, offset_deg: float) -> Self:
        """Return the same calibration with its result scaled, then shifted [deg]."""
        first, shift_deg = self.correction
        return self.model_copy(update={"correction": (scale * first, scale * shift_deg + offset_deg)})

    @abstractmethod
    def _convert(self, values: FloatArray) -> FloatArray:
        """Deflection before the correction [deg]."""

    @abstractmethod
    def _restore(self, deflection_deg: FloatArray) -> FloatArray:
        """Undo `_convert`."""


class DegreeCalibration(_Channel):
    """A channel in degrees: ``deflection = sign * (value - trim_deg)``.

    Examples
    --------
    >>> DegreeCalibration(channel="elevator_pos_deg", unit="deg", trim_deg=0.5).to_deg(np.array([1.5]))
    array([1.])
    """

    unit: Literal["deg"]
    trim_deg: Finite = 0.0
    pulse: tuple[Finite, Finite] | None = None
    """Where a log has pulses only: the pulse of 0 deg [us], and degrees of this channel for each microsecond."""

    def _convert(self, values: FloatArray) -> FloatArray:
        return self.sign * (values - self.trim_deg)

    def _restore(self, deflection_deg: FloatArray) -> FloatArray:
        return self.sign * deflection_deg + self.trim_deg


class RadianCalibration(_Channel):
    """A channel in radians: ``deflection = sign * degrees(value - trim_rad)``."""

    unit: Literal["rad"]
    trim_rad: Finite = 0.0

    def _convert(self, values: FloatArray) -> FloatArray:
        deflection: FloatArray = self.sign * np.degrees(values - self.trim_rad)
        return deflection

    def _restore(self, deflection_deg: FloatArray) -> FloatArray:
        logged: FloatArray = self.sign * np.radians(deflection_deg) + self.trim_rad
        return logged


class _Scaled(_Channel):
    """A straight line through the trim, or a cubic where the linkage needs one."""

    def _scale(self, values: FloatArray, trim: float, slope: float | None, cubic: Cubic | None) -> FloatArray:
        if cubic is not None:
            bent: FloatArray = self.sign * np.polyval(np.array(cubic[::-1]), values)
            return bent
        return self.sign * (slope or 0.0) * (values - trim)

    def _unscale(self, deflection_deg: FloatArray, trim: float, slope: float | None) -> FloatArray:
        if slope is None:
            raise ConfigError(f"channel {self.channel!r}: a cubic calibration cannot be written back to a log")
        return self.sign * deflection_deg / slope + trim


def _one_of(slope: float | None, cubic: Cubic | None, slope_key: str) -> None:
    if (slope is None) == (cubic is None) or slope == 0.0:
        raise ValueError(f"give either {slope_key} (not zero) or cubic_deg = [c0, c1, c2, c3]")


class PulseCalibration(_Scaled):
    """A pulse width: ``deflection = sign * slope_deg_per_us * (value - trim_us)``, or a cubic in it.

    Examples
    --------
    >>> pulse = PulseCalibration(channel="pwm", unit="us", trim_us=1500.0, slope_deg_per_us=0.1)
    >>> pulse.to_deg(np.array([1600.0]))
    array([10.])
    """

    unit: Literal["us"]
    trim_us: Finite = 1500.0
    slope_deg_per_us: Finite | None = None
    cubic_deg: Cubic | None = None

    @model_validator(mode="after")
    def _complete(self) -> Self:
        _one_of(self.slope_deg_per_us, self.cubic_deg, "slope_deg_per_us")
        return self

    def _convert(self, values: FloatArray) -> FloatArray:
        # A pulse that was not sent is logged as 0.
        pulses = np.where(values > 0.0, values, np.nan)
        return self._scale(pulses, self.trim_us, self.slope_deg_per_us, self.cubic_deg)

    def _restore(self, deflection_deg: FloatArray) -> FloatArray:
        return self._unscale(deflection_deg, self.trim_us, self.slope_deg_per_us)


class CountCalibration(_Scaled):
    """Converter or timer counts: ``deflection = sign * slope_deg_per_count * (value - trim_count)``, or a cubic."""

    unit: Literal["count"]
    trim_count: Finite = 0.0
    slope_deg_per_count: Finite | None = None
    cubic_deg: Cubic | None = None

    @model_validator(mode="after")
    def _complete(self) -> Self:
        _one_of(self.slope_deg_per_count, self.cubic_deg, "slope_deg_per_count")
        return self

    def _convert(self, values: FloatArray) -> FloatArray:
        return self._scale(values, self.trim_count, self.slope_deg_per_count, self.cubic_deg)

    def _restore(self, deflection_deg: FloatArray) -> FloatArray:
        return self._unscale(deflection_deg, self.trim_count, self.slope_deg_per_count)


class NormCalibration(_Scaled):
    """A command from -1 to 1: ``deflection = sign * slope_deg * (value - trim)``.

    Examples
    --------
    >>> NormCalibration(channel="control[0]", unit="norm", slope_deg=25.0).to_deg(np.array([-1.0, 0.5]))
    array([-25. ,  12.5])
    """

    unit: Literal["norm"]
    trim: Finite = 0.0
    slope_deg: Finite

    def _convert(self, values: FloatArray) -> FloatArray:
        return self._scale(values, self.trim, self.slope_deg, None)

    def _restore(self, deflection_deg: FloatArray) -> FloatArray:
        return self._unscale(deflection_deg, self.trim, self.slope_deg)


class RadianOrCountCalibration(_Scaled):
    """The FASER position columns: documented in radians, written as raw converter counts.

    Values that mostly lie beyond any angle in radians are counts; everything else is taken as radians.
    """

    unit: Literal["rad_or_count"]
    trim_count: Finite
    slope_deg_per_count: Finite

    def _convert(self, values: FloatArray) -> FloatArray:
        finite = values[np.isfinite(values)]
        if finite.size and np.median(np.abs(finite)) > _LARGEST_ANGLE_RAD:
            return self._scale(values, self.trim_count, self.slope_deg_per_count, None)
        deflection: FloatArray = self.sign * np.degrees(values)
        return deflection

    def _restore(self, deflection_deg: FloatArray) -> FloatArray:
        # A converter gives whole numbers.
        counts: FloatArray = np.round(self._unscale(deflection_deg, self.trim_count, self.slope_deg_per_count))
        return counts


Calibration = Annotated[
    DegreeCalibration
    | RadianCalibration
    | PulseCalibration
    | CountCalibration
    | NormCalibration
    | RadianOrCountCalibration,
    Field(discriminator="unit"),
]
