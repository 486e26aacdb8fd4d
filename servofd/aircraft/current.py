"""What an aircraft file says of currents: where they are logged, and what a healthy one is."""

from __future__ import annotations

from typing import Annotated, Final, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from servofd.aircraft.calibrated import Learned, NotNegative, Positive, Terms, symmetric
from servofd.aircraft.calibration import Entry
from servofd.core.types import FloatArray

REGRESSORS: Final = {
    "idle": "A, whatever it does",
    "hold": "A for each 10 deg to either side in the usual air",
    "side": "A for each 10 deg to the positive side in the usual air",
    "up": "A of friction while the deflection grows",
    "down": "A of friction while it falls",
    "speed": "A for each 100 deg/s",
    "against": "A for each 10 deg while it moves away from its middle in the usual air",
    "acceleration": "A for each 1000 deg/s^2 along the motion",
    "up_1": "A of friction at the upper end of its reach more than in the middle, growing",
    "up_2": "A of friction at both ends more than in the middle, growing",
    "down_1": "A of friction at the upper end of its reach more than in the middle, falling",
    "down_2": "A of friction at both ends more than in the middle, falling",
    "supply": "A for each volt above the usual supply",
}
"""Terms of a healthy current, and what each is in."""
NAMES: Final = tuple(REGRESSORS)
FEATURES: Final = ("more_up", "more_down", "spread_up", "spread_down", "rough_up", "rough_down")
"""What wear changes: by how much more is left of the current in motion than at rest [A], and the logarithms of its
spread and of its steps from reading to reading."""
AMPERES: Final = {"A": 1.0, "mA": 1e-3, "cA": 1e-2}
"""Amperes for each unit of a current; MAVLink counts those of batteries in hundredths."""


class CurrentSource(Entry):
    """A channel that holds a current, and the one that holds the supply beside it."""

    channel: Annotated[str, Field(min_length=1)]
    unit: Literal["A", "mA", "cA"]
    voltage: str = ""
    """Channel of the supply [V]; left out, what the log holds for all servos."""

    @property
    def scale(self) -> float:
        """Amperes for each unit."""
        return AMPERES[self.unit]


class CurrentNoise(Learned):
    """What a healthy current does beside its model: ``sigma^2 = still_a^2 + (share * current of motion)^2``."""

    still_a: Positive
    share: NotNegative
    colour: Annotated[float, Field(ge=0.0, lt=1.0)]
    """Correlation of neighbouring samples."""
    period_s: Positive


class Wear(Learned):
    """`FEATURES` of good flights or cycles, and what they differ by."""

    mean: tuple[float, ...]
    between: tuple[tuple[float, ...], ...]
    """Covariance of one more flight: lower triangle."""
    limit: Positive
    """Squared distance, over the number of features, that a good flight stays below."""
    flights: Annotated[int, Field(ge=1)]
    """Or cycles, from which this is known."""

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if len(self.mean) != len(FEATURES) or [len(row) for row in self.between] != list(range(1, len(FEATURES) + 1)):
            raise ValueError(f"mean and the lower triangle of between are needed for {len(FEATURES)} features")
        return self

    @property
    def covariance(self) -> FloatArray:
        """Shape (6, 6)."""
        return symmetric(self.between)


class CalibratedCurrent(Terms):
    """The current of a healthy servo, how far it may differ between flights, and what wear changes.

    Its parameters are `REGRESSORS`.

    Examples
    --------
    >>> current = CalibratedCurrent(
    ...     parameters=dict.fromkeys(NAMES, 0.1), between=[[1e-4 * (i == k) for k in range(i + 1)] for i in range(13)],
    ...     noise={"still_a": 0.02, "share": 0.3, "colour": 0.2, "period_s": 0.1}, lag_s=0.02, width_s=0.0,
    ...     reach_deg=(-20.0, 20.0), explained_share=0.8, most_a=0.5,
    ... )
    >>> current.theta.shape, current.covariance.shape
    ((13,), (13, 13))
    """

    NAMES = NAMES
    STRANGE = f"parameters: {', '.join(NAMES)} are needed, all of them and no other; see {{}}"
    noise: CurrentNoise
    lag_s: Annotated[float, Field(ge=0.0, le=2.0)]
    """By which a reading comes after the motion that it belongs to."""
    width_s: Annotated[float, Field(ge=0.0, le=60.0)]
    """Over which a reading averages."""
    reach_deg: tuple[float, float]
    explained_share: float
    most_a: Positive
    """What it draws in motion, but for a reading in a thousand."""
    moving_a: NotNegative = 0.0
    """What it draws by its model, but for a reading in a hundred of its good flights; 0 where that was not kept."""
    supply_v: NotNegative = 0.0
    """Usual supply; 0 where it was not logged."""
    airspeed_m_s: NotNegative = 0.0
    """Usual airspeed; 0 where it was not logged."""
    airspeeds_m_s: tuple[float, float] | None = None
    """The slowest and the fastest that was flown while it was fitted; None where it was not logged."""
    limits_nats: dict[Literal["blocked", "unpowered", "binding"], Positive] = {}
    """Nats by which each fault must be likelier than a good servo: more than any stretch of good flights reached."""
    fitted_between_s: tuple[float, float] | None = None
    """The part of a log that it was fitted to, where it was not calibrated."""
    wear: Wear | None = None

    @model_validator(mode="before")
    @classmethod
    def _without_old_limits(cls, given: object) -> object:
        """Files of before hold the limits of other tests: the usual ones serve as well."""
        return {key: value for key, value in given.items() if key != "limits"} if isinstance(given, dict) else given

    @model_validator(mode="after")
    def _definite(self) -> Self:
        if np.linalg.eigvalsh(self.covariance)[0] <= 0.0:
            raise ValueError("between: not a covariance, as it is not positive definite")
        return self

    @property
    def late_s(self) -> tuple[float, float]:
        """By how much its readings come late, and over how long they average."""
        return self.lag_s, self.width_s
