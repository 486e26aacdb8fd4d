"""What an identification found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from servofd.core.evidence import what_is_unknown
from servofd.core.series import rms
from servofd.core.statistics import Estimate
from servofd.core.types import ComplexArray, FloatArray

if TYPE_CHECKING:
    from servofd.aircraft.series import Series
    from servofd.identification.motion import ServoCandidate
    from servofd.identification.records import Run
    from servofd.identification.response import FrequencyResponse


@dataclass(frozen=True, slots=True, eq=False)
class Identification:
    """A servo, how sure its numbers are, and the evidence.

    The delay is the transport delay alone; the zero-order hold of the command is modelled apart.
    """

    surface: str
    method: str
    """``"response"`` (frequency response, then motion), or ``"motion"`` (no sweep: motion alone)."""
    servo: ServoCandidate
    intervals: Mapping[str, Estimate]
    """95 % intervals by name: ``delay_s``, ``dc_gain``, ``bandwidth_rad_s``, ``lag_s``, ``pole_0_real_rad_s`` ..."""
    notes: tuple[str, ...]
    runs: tuple[Run, ...]
    errors_deg: tuple[FloatArray, ...]
    """Measured minus simulated position of each run [deg]."""
    offset_deg: float
    """Position at a command of zero, mean of the servos [deg]."""
    response: FrequencyResponse | None = None
    """Nominal smoothed response, mean of the servos."""
    responses: tuple[FrequencyResponse, ...] = ()
    """Smoothed response of each servo."""
    band_rad_s: tuple[float, float] | None = None
    """Where the position follows the command with a coherence above 0.8 [rad/s]."""
    segments: tuple[Series, ...] = ()
    """The tests as an audit cuts them: what thresholds are drafted from."""

    @property
    def poles_rad_s(self) -> ComplexArray:
        """Poles [rad/s], shape (order,)."""
        return self.servo.linear.poles_rad_s

    @property
    def rate_limit_deg_s(self) -> float | None:
        """Rate limit, mean of both directions [deg/s]; None if none was seen."""
        rates = [r for r in (self.servo.rate_up_deg_s, self.servo.rate_down_deg_s) if r is not None]
        return float(np.mean(rates)) if rates else None

    @property
    def not_told(self) -> str:
        """What these tests do not tell of the servo, and which would; empty if they tell all of it."""
        what = what_is_unknown(self.intervals.get("dc_gain"), self.intervals.get("bandwidth_rad_s"))
        return what and f"this test does not tell {what}"

    @property
    def rms_deg(self) -> float:
        """Root mean square of measured minus simulated position [deg]."""
        return rms(np.concatenate(self.errors_deg))

    @property
    def fits_percent(self) -> tuple[float, ...]:
        """Of each run: 100 (1 - |error| / |position about its mean|), MATLAB's fit."""
        fits = []
        for run, error in zip(self.runs, self.errors_deg, strict=True):
            motion = float(np.linalg.norm(run.measured_deg - run.measured_deg.mean()))
            fits.append(100.0 * (1.0 - float(np.linalg.norm(error)) / max(motion, 1e-12)))
        return tuple(fits)

    def normalized_errors(self) -> tuple[FloatArray, ...]:
        r"""Of each servo, at the frequencies of `responses`: :math:`|G_{sm,i} - G_{fit}| / |G_{fit}|` (Eq. 3.2)."""
        return tuple(
            np.abs(r.response / self.servo.linear.sampled_response(r.frequency_rad_s, r.sample_time_s) - 1.0)
            for r in self.responses
        )

    @property
    def max_normalized_error(self) -> float | None:
        """Largest of Eq. 3.2 within the band; None without a frequency response."""
        if self.band_rad_s is None:
            return None
        low, high = self.band_rad_s
        inside = [
            e[(r.frequency_rad_s >= low) & (r.frequency_rad_s <= high)].max()
            for r, e in zip(self.responses, self.normalized_errors(), strict=True)
        ]
        return float(max(inside))

    def document(self) -> dict[str, Any]:
        """Schema servofd.identify/1 as plain dictionaries and lists."""
        linear = self.servo.linear
        return {
            "schema": "servofd.identify/1",
            "surface": self.surface,
            "method": self.method,
            "poles": [[float(p.real), float(p.imag)] for p in self.poles_rad_s],
            "dc_gain": linear.gain,
            "delay_s": linear.delay_s,
            "hold": "zoh",
            "lag_s": linear.lag_s,
            "bandwidth_rad_s": linear.transfer.bandwidth_rad_s,
            "rate_limit_deg_s": self.rate_limit_deg_s,
            "rate_up_deg_s": self.servo.rate_up_deg_s,
            "rate_down_deg_s": self.servo.rate_down_deg_s,
            "dead_band_deg": self.servo.dead_band_deg,
            "offset_deg": self.offset_deg,
            "numerator": list(linear.transfer.numerator),
            "denominator": list(linear.transfer.denominator),
            "coherence_band_rad_s": list(self.band_rad_s) if self.band_rad_s else None,
            "fit_error": {
                "rms_deg": self.rms_deg,
                "max_normalized_error": self.max_normalized_error,
                "fit_percent": list(self.fits_percent),
            },
            "uncertainty": {name: {"low": i.low, "high": i.high} for name, i in self.intervals.items()},
            "notes": list(self.notes),
        }
