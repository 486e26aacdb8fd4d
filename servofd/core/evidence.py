"""What a model has earned the right to say, and what a flight would have shown: the ground under every verdict."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field

from servofd.core.statistics import Estimate

Origin = Literal["calibrated", "named", "fitted", "none"]

_SizeDeg = Annotated[float, Field(ge=0.0)]
_Share = Annotated[float, Field(le=1.0)]


class ModelOrigin(BaseModel):
    """Where a servo's model comes from, and how well it predicts what it was not fitted to.

    Examples
    --------
    >>> ModelOrigin(origin="fitted", held_out_rms_deg=0.05, explained_share=0.998).origin
    'fitted'
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    origin: Origin = "named"
    """``calibrated`` on good flights; ``named`` by the user; ``fitted`` to the very log; ``none`` predicts nothing."""
    held_out_rms_deg: _SizeDeg | None = None
    """Error of the prediction on what the model was not fitted to [deg]; None if that is not known."""
    explained_share: _Share | None = None
    """Share of the motion's power there that the model explains: 1 all of it, below 0 worse than no model."""
    good_runs: Annotated[int, Field(ge=1)] | None = None
    """How many runs, known to be good, model and threshold come from; None if none is known to be good."""
    fitted_between_s: tuple[float, float] | None = None
    """Which part of the log that is judged the model was fitted to; None where it was not fitted to it."""

    @property
    def predicts(self) -> bool:
        """Whether there is a model at all."""
        return self.origin != "none"


NAMED = ModelOrigin()


@dataclass(frozen=True, slots=True)
class Detectable:
    """The smallest fault of each kind that a log would have shown, 19 times in 20; None where none could be shown.

    `bias_deg`: constant offset [deg]. `slow_share`: share of its speed that the servo has left. `loss_share`: share of
    the travel that is lost. `deadband_deg`: full width of dead band or play [deg]. `oscillation_deg`: amplitude of an
    oscillation [deg].

    Examples
    --------
    >>> Detectable(bias_deg=0.8, loss_share=0.2).missing
    ('slow_share', 'deadband_deg', 'oscillation_deg')
    """

    bias_deg: float | None = None
    slow_share: float | None = None
    loss_share: float | None = None
    deadband_deg: float | None = None
    oscillation_deg: float | None = None

    @property
    def missing(self) -> tuple[str, ...]:
        """Kinds that this log could not have shown."""
        return tuple(field.name for field in fields(self) if getattr(self, field.name) is None)

    def document(self) -> dict[str, float | None]:
        """As in JSON."""
        return asdict(self)

    @classmethod
    def from_document(cls, document: dict[str, Any]) -> Self:
        """What `document` gave; keys that are not known are left out."""
        return cls(**{field.name: document.get(field.name) for field in fields(cls)})


NOTHING_DETECTABLE = Detectable()


USUAL_GAINS = (0.8, 1.25)
"""Gains of a servo whose scale is right."""
_MOST_APART = 3.0
"""A bandwidth that may as well be three times as large is not known."""
_SWEEP_TO = 4.0
"""Times the bandwidth to which a sweep should go: those that tell an HS-225BB are coherent to 126 of its 28.5 rad/s."""


def what_is_unknown(gain: Estimate | None, bandwidth_rad_s: Estimate | None) -> str:
    """What is not known of a servo whose gain and bandwidth may lie so far apart, and what would tell it; or nothing.

    Examples
    --------
    >>> what_is_unknown(Estimate(1.0, 0.9, 1.1), Estimate(30.0, 28.0, 32.0))
    ''
    >>> what_is_unknown(Estimate(1.0, -0.9, 2.9), None)
    'the gain (-0.9 to 2.9): ask for slow movements that are many times as large as the noise of the position'
    """
    if gain is not None and gain.low <= 0.0 <= gain.high:
        return (
            f"the gain ({gain.low:.2g} to {gain.high:.2g}): ask for slow movements that are many times as large as the "
            "noise of the position"
        )
    if bandwidth_rad_s is not None and not bandwidth_rad_s.high <= _MOST_APART * bandwidth_rad_s.low:
        return (
            f"the bandwidth ({bandwidth_rad_s.low:.0f} to {bandwidth_rad_s.high:.0f} rad/s): sweep slowly up to "
            f"{_SWEEP_TO * bandwidth_rad_s.value:.0f} rad/s, and log the position at 50 Hz or more"
        )
    return ""
