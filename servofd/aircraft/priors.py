"""The parameters of the servos that a calibration fits, and what is known of each before any flight.

Those of every servo come first, in a fixed order; then those of effects that say how much sound servos differ in them
(`servofd.servo.effect.Parameter.calibrated`).
"""

from __future__ import annotations

from typing import Final, NamedTuple

from servofd.servo.effect import Effect
from servofd.servo.registry import everything


class Prior(NamedTuple):
    """What is known of a parameter before any flight."""

    name: str
    unit: str
    value: float
    sigma: float
    """Between servos."""
    low: float
    high: float
    between: float
    """Standard deviation between good flights of one servo; measured on simulated aircraft of even seed."""
    step: float
    """For differences."""


ADDED: Final = tuple(each for each in everything() if any(p.calibrated for p in each.parameters))
"""Effects whose parameters are fitted beside those of every servo."""
_STEP: Final = 0.2
"""Step for differences over the deviation between servos, about as of the other parameters."""
_UNITS: Final = ("deg_s", "deg", "s")
"""Units with which names of parameters end; others have none."""


def _added(effect: type[Effect]) -> tuple[Prior, ...]:
    """What is known of the parameters of an effect; each is named after its field of `Physics`."""
    found = []
    for p in effect.parameters:
        if p.calibrated:
            unit = next((unit for unit in _UNITS if p.name.endswith(f"_{unit}")), "")
            servos, flights = p.calibrated
            found.append(Prior(p.fields[0], unit, p.neutral, servos, p.low, p.high, flights, _STEP * servos))
    return tuple(found)


PRIORS: Final = (
    Prior("gain", "", 1.0, 0.15, 0.05, 3.0, 0.012, 0.005),
    Prior("bias_deg", "deg", 0.0, 2.0, -40.0, 40.0, 0.25, 0.05),
    Prior("delay_s", "s", 0.03, 0.05, 0.0, 0.4, 0.006, 0.001),
    Prior("ln_bandwidth", "ln rad/s", 3.7, 0.8, 1.0, 5.7, 0.035, 0.02),
    Prior("ln_damping", "", 0.0, 0.35, -1.6, 1.6, 0.08, 0.02),
    Prior("ln_rate", "ln deg/s", 5.8, 0.7, 2.0, 8.5, 0.05, 0.02),
    Prior("deadband_deg", "deg", 0.1, 0.4, 0.0, 8.0, 0.12, 0.1),
    Prior("friction_deg", "deg", 0.1, 0.4, 0.0, 5.0, 0.12, 0.1),
    Prior("play_deg", "deg", 0.05, 0.3, 0.0, 8.0, 0.12, 0.1),
    Prior("hinge", "", 0.02, 0.1, -0.3, 1.0, 0.02, 0.01),
    Prior("hinge_deg", "deg", 0.0, 0.3, -5.0, 5.0, 0.1, 0.05),
    Prior("bend2_deg", "deg", 0.0, 0.5, -5.0, 5.0, 0.05, 0.1),
    Prior("bend3_deg", "deg", 0.0, 0.5, -5.0, 5.0, 0.05, 0.1),
    *(prior for effect in ADDED for prior in _added(effect)),
)
"""What a calibration fits, with how far servos may be from the usual one: `Prior` names the columns."""
NAMES: Final = tuple(prior.name for prior in PRIORS)
FITTED: Final = len(PRIORS)
