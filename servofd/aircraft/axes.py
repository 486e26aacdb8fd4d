"""What calibration learned of an aircraft's axes; the ``[motion]`` table of its file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from servofd.aircraft.calibrated import Learned, NotNegative, Positive
from servofd.core.statistics import Z_95
from servofd.core.toml_text import toml_lines, toml_value
from servofd.core.types import FloatArray

AXES = ("roll", "pitch", "side", "thrust")
"""In which order they are shown; ``thrust`` is the engine, whose loss must not be blamed on a surface."""

SURFACE_AXES = AXES[:3]
"""Those that surfaces turn."""

MOST_OF_THE_FLIGHT = 0.5
"""Share of the flight in which an axis must be judged, and its lost share known, for ``healthy``."""

FORM_NAMES: Mapping[str, int] = {
    "roll_rate": 4,
    "roll_acceleration": 4,
    "pitch_inverse": 6,
    "pitch_acceleration": 5,
    "side_force": 4,
    "yaw_rate": 5,
    "yaw_acceleration": 5,
    "specific_thrust": 3,
}
"""Each form and how much else than the command moves the aircraft in it."""


class Spread(Learned):
    """How far windows of one length stray in healthy flights, and flights from each other as far again."""

    window_s: Positive
    loss_var: NotNegative
    cross_us: float
    offset_var_us2: NotNegative
    scale: Positive = 1.0
    """Largest J of the calibration flights, each judged by a model that has not seen its day."""
    lag_var_s2: NotNegative = 0.0
    lag_scale: Positive | None = None
    """As `scale`, of the lag; None if these windows do not tell it."""

    @classmethod
    def of(cls, window_s: float, covariance: FloatArray) -> Spread:
        """Lower triangle of a covariance, shape (2, 2)."""
        (loss_var, cross), (_, offset_var) = covariance.tolist()
        return cls(window_s=window_s, loss_var=loss_var, cross_us=cross, offset_var_us2=offset_var)

    @property
    def covariance(self) -> FloatArray:
        """P_window, and P_flight as well, shape (2, 2)."""
        return np.array([[self.loss_var, self.cross_us], [self.cross_us, self.offset_var_us2]])

    def samples(self, rate_hz: float) -> int:
        """Length of the window."""
        return max(4, round(self.window_s * rate_hz))


class Regime(Learned):
    """Where the calibration flights were; nothing is judged outside."""

    airspeed_low_m_s: float
    airspeed_high_m_s: float
    throttle_low: float
    lift_high_m_s2: float
    """Largest -az / (V / V0)^2: beyond it the wing is nearer to its stall than it ever was."""


class AxisModel(Learned):
    """Model of one axis, and how far healthy flights stray from it."""

    form: str
    corner_hz: Positive
    delay_s: Annotated[float, Field(ge=0.0, le=2.0)]
    gain: float
    """K: motion for each microsecond of command at the reference airspeed; 1 for an inverse form."""
    offset: float
    others: tuple[float, ...]
    whitening: tuple[float, ...] = ()
    """Autoregression of the residual that is taken out of everything."""
    noise_var: Positive
    """Of the residual, times what its colour makes of sums."""
    residual_var: NotNegative = 0.0
    """Of the residual alone; 0 if windows are not to be judged by what they leave unexplained themselves."""
    spreads: tuple[Spread, ...] = Field(min_length=1)
    of_flight: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.5
    """Share of what healthy windows differ by that is the flight's own, and so learned from it."""
    flights: Annotated[int, Field(ge=1)] = 4
    """That taught it; 4 where a file does not say."""
    own_command: bool = True
    """False if its command always was a copy of another axis' command."""
    explained: float
    """Share of the command's effect that the model explains on days it has not seen."""
    suspect: Positive = 1.0
    fault: Positive | None = None
    """Multiples of the calibration's largest statistic; None: the calibrated hours support none."""
    false_alarms_per_hour: float = 0.0
    members: tuple[str, ...] = ()

    def of_flights(self, window: FloatArray) -> FloatArray:
        """Covariance between flights beside that between the windows of one."""
        return window * self.of_flight / (1.0 - self.of_flight)

    @property
    def widening(self) -> float:
        """Student's interval over the normal one: what flights differ by was learned from a few of them."""
        from scipy import special  # takes longer to load than a flight to judge

        return float(special.stdtrit(max(self.flights - 1, 1), 0.975)) / Z_95

    @model_validator(mode="after")
    def _known(self) -> Self:
        if self.form not in FORM_NAMES:
            raise ValueError(f"form: there are {', '.join(FORM_NAMES)}")
        if len(self.others) != FORM_NAMES[self.form]:
            raise ValueError(f"others: {self.form} has {FORM_NAMES[self.form]} of them")
        return self


class MotionModel(Learned):
    """Models of all axes of an aircraft without position feedback."""

    rate_hz: Positive
    reference_m_s: Positive
    regime: Regime
    days: int
    flights: int
    hours: float
    axes: dict[str, AxisModel] = Field(min_length=1)
    parameters: dict[str, float] = Field(default_factory=dict)
    """SERVOn_... of the outputs that move surfaces and engines: for logs and links that do not tell them."""
    left_out: tuple[str, ...] = ()
    """Logs that were given and taught nothing, and why."""

    @model_validator(mode="after")
    def _named(self) -> Self:
        strange = [name for name in self.axes if name not in AXES]
        if strange:
            raise ValueError(f"axes: there are {', '.join(AXES)}, not {strange[0]}")
        return self


_COMMENTS = {
    "rate_hz": "samples a second at which it is judged",
    "reference_m_s": "airspeed at which the gains below hold",
    "days": "of the calibration flights: the more, the fewer false alarms",
    "explained": "share of the command's effect explained on days the model had not seen",
    "own_command": "false: its command always was a copy of another axis'",
    "suspect": "multiple of the largest statistic of the calibration flights",
    "fault": "multiple that is exceeded wrongly once in a hundred hours",
}


def motion_to_toml(model: MotionModel) -> str:
    """Text of the table, to stand at the end of an aircraft file."""
    document = model.model_dump(exclude_none=True)
    axes, regime = document.pop("axes"), document.pop("regime")
    lines = [
        "# How the aircraft's motion answers its axes: fitted to healthy flights by servofd calibrate.",
        "[motion]",
    ]
    lines += toml_lines(document, _COMMENTS)
    lines += [
        "",
        "[motion.regime] # where the calibration flights were: nothing is judged outside",
        *toml_lines(regime, _COMMENTS),
    ]
    for name, axis in axes.items():
        spreads = axis.pop("spreads")
        lines += ["", f"[motion.axes.{name}]", *toml_lines(axis, _COMMENTS), "spreads = ["]
        lines += [f"    {toml_value(spread)}," for spread in spreads]
        lines += ["]"]
    return "\n".join(lines) + "\n"
