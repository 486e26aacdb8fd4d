"""How far a healthy servo may differ from its model: the physical tolerances behind thresholds and the bank."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

_NonNegative = Annotated[float, Field(ge=0.0, lt=1e3, strict=True)]
"""Type of a tolerance: zero or more, and below 1000."""
_Share = Annotated[float, Field(ge=0.0, lt=1.0, strict=True)]
_WIDEST = {"gain": 0.9, "bandwidth": 0.9, "rate": 0.9, "delay_s": 999.0, "bias_deg": 999.0, "noise_deg": 999.0}


class Tolerance(BaseModel):
    """Largest deviations that still count as healthy.

    The defaults are the spread of a fleet of healthy HS-225BB servos whose largest residual under FASER-like
    commands is 1.4 deg: it is the spread for which the thesis' threshold of 1.5 deg is right.

    Examples
    --------
    >>> Tolerance().scaled(2.0).delay_s
    0.006
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    gain: _Share = 0.03
    """Share of the deflection."""
    delay_s: _NonNegative = 0.003
    bandwidth: _Share = 0.10
    """Share of the bandwidth."""
    rate: _Share = 0.10
    """Share of the rate limit; supply voltage and load are in it."""
    bias_deg: _NonNegative = 0.3
    noise_deg: _NonNegative = 0.2
    """Standard deviation of the position measurement; the measured one takes over as the flight goes on."""

    def scaled(self, factor: float) -> Tolerance:
        """Return tolerances `factor` times as wide, as far as they may be: shares to 0.9, the others to 999."""
        return Tolerance(**{key: min(_WIDEST[key], factor * getattr(self, key)) for key in type(self).model_fields})
