"""What of a servo a flight can tell: the numbers that calibration fits."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from servofd.servo.effects import Delay, Effect, LinearDynamics, PositionLimit, RateLimit
from servofd.servo.library import Servo, second_order
from servofd.servo.servo_model import ServoModel

if TYPE_CHECKING:
    from servofd.aircraft.schema import Aircraft
    from servofd.core.types import FloatArray
    from servofd.servo.transfer import TransferFunction

NUMBERS = ("bandwidth_hz", "damping", "delay_s", "rate_limit_deg_s")
"""What is fitted beside scale and offset of the position, in this order."""

_MILLISECOND_S = 1e-3
_LONGEST_DELAY_S = 0.5
_BANDWIDTHS_HZ, _DAMPINGS, _RATES_DEG_S = (0.1, 200.0), (0.2, 10.0), (5.0, 1e4)


@dataclass(frozen=True, slots=True)
class FlownServo:
    """A servo of an aircraft file, with numbers of its own.

    Parameters
    ----------
    prior : Servo
        As the aircraft file describes it.
    bandwidth_hz : float
        3.00 dB below dc [Hz]; a servo given by polynomials has its poles and zeros scaled.
    damping : float or None
        Of a servo given by bandwidth and damping; None for one given by polynomials.
    delay_s : float
        Transport delay [s].
    rate_limit_deg_s : float or None
        [deg/s]; None if it has none.
    stops_deg : tuple of float, optional
        Of the linkage [deg].

    Examples
    --------
    >>> from servofd.servo.library import servo_named
    >>> servo = FlownServo.of(servo_named("hs225bb-eq31"))
    >>> round(servo.bandwidth_hz, 2), servo.delay_s, servo.numbers
    (4.53, 0.004, ('bandwidth_hz', 'delay_s', 'rate_limit_deg_s'))
    """

    prior: Servo
    bandwidth_hz: float
    damping: float | None
    delay_s: float
    rate_limit_deg_s: float | None
    stops_deg: tuple[float, float] | None = None

    @classmethod
    def of(cls, servo: Servo, stops_deg: tuple[float, float] | None = None) -> FlownServo:
        """The servo as described."""
        return cls(
            servo,
            servo.transfer.bandwidth_rad_s / (2.0 * np.pi),
            servo.damping,
            servo.transport_delay_s,
            servo.rate_limit_deg_s,
            stops_deg,
        )

    @classmethod
    def on(cls, aircraft: Aircraft, surface: str) -> FlownServo:
        """The servo that turns a surface."""
        return cls.of(aircraft.servo(surface), aircraft.surfaces[surface].position_limit_deg)

    @property
    def numbers(self) -> tuple[str, ...]:
        """Names of the numbers that this servo has, of `NUMBERS`."""
        return tuple(name for name in NUMBERS if getattr(self, name) is not None)

    @property
    def transfer(self) -> TransferFunction:
        """Linear dynamics."""
        if self.damping is not None:
            return second_order(2.0 * np.pi * self.bandwidth_hz, self.damping)
        return self.prior.transfer.with_bandwidth_scaled(self.bandwidth_scale)

    @property
    def bandwidth_scale(self) -> float:
        """Bandwidth over that of the description."""
        return 2.0 * np.pi * self.bandwidth_hz / self.prior.transfer.bandwidth_rad_s

    @property
    def model(self) -> ServoModel:
        """Healthy model with these numbers."""
        effects: list[Effect] = [Delay(self.delay_s), LinearDynamics(self.transfer)]
        if self.rate_limit_deg_s is not None:
            effects.append(RateLimit(self.rate_limit_deg_s))
        if self.stops_deg is not None:
            effects.append(PositionLimit(*self.stops_deg))
        return ServoModel(tuple(effects))

    def vector(self, names: tuple[str, ...]) -> FloatArray:
        """Some numbers as they are fitted: logarithms of what must stay positive, delays in milliseconds."""
        values = {name: float(getattr(self, name)) for name in names}
        return np.array([v / _MILLISECOND_S if name == "delay_s" else np.log(v) for name, v in values.items()])

    def with_vector(self, names: tuple[str, ...], x: FloatArray) -> FlownServo:
        """The same servo with other numbers; those beyond any servo are brought back.

        Examples
        --------
        >>> from servofd.servo.library import servo_named
        >>> servo = FlownServo.of(servo_named("s3151"))
        >>> servo.with_vector(("delay_s",), np.array([7.0])).delay_s
        0.007
        """
        limits = {"bandwidth_hz": _BANDWIDTHS_HZ, "damping": _DAMPINGS, "rate_limit_deg_s": _RATES_DEG_S}
        changed: dict[str, Any] = {
            name: float(np.clip(_MILLISECOND_S * value, 0.0, _LONGEST_DELAY_S))
            if name == "delay_s"
            else float(np.exp(np.clip(value, *np.log(limits[name]))))
            for name, value in zip(names, x.tolist(), strict=True)
        }
        return replace(self, **changed)
