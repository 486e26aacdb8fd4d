"""How far a servo may wear before it is to be replaced."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

_Positive = Annotated[float, Field(gt=0.0, lt=1e5, strict=True)]
_Share = Annotated[float, Field(ge=0.0, lt=1.0, strict=True)]


class Limits(BaseModel):
    """Limits of what `servofd trend` follows; what is left out follows from the surface's tolerances."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    dead_band_deg: _Positive = 2.0
    """Full width of dead band or backlash. The thesis' threshold of 1.5 deg alarms at 3 deg (4.2.1); at 2 deg two
    thirds of it are used up."""
    bias_deg: _Positive | None = None
    """To either side; None: the constant threshold."""
    delay_s: _Positive | None = None
    """None: the model's, and five tolerances."""
    bandwidth_hz: _Positive | None = None
    """None: the model's, less three tolerances."""
    rate_limit_deg_s: _Positive | None = None
    """None: the model's, less three tolerances."""
    rate_per_volt_deg_s_v: _Positive | None = None
    """None: none."""
    noise_deg: _Positive | None = None
    """None: three tolerances."""
    residual_p95_deg: _Positive | None = None
    """None: the constant threshold."""
    margin: _Share = 0.0
    """Share of the threshold that must be left."""
