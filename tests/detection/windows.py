"""Flights of known faults."""

from __future__ import annotations

import numpy as np

from servofd.aircraft.marks import Rows, Why, marked
from servofd.aircraft.schema import plain_aircraft
from servofd.aircraft.series import Series, is_unsettled
from servofd.core.types import FloatArray
from servofd.detection.faults import Found
from servofd.detection.residual import ResidualGenerator, Residuals, ThresholdKind
from servofd.detection.seen import Healthy
from servofd.servo.faults import Failure
from servofd.servo.library import servo_named
from servofd.servo.servo_model import ServoModel
from servofd.simulation.commands import COMMANDS
from tests.detection.tolerated import MODEL

__all__ = ["NOISE_DEG", "command", "flown", "judged", "residuals_of", "troubled"]

GENERATOR = ResidualGenerator(MODEL, 50.0)
NOISE_DEG = 0.1


def command(seed: int, time_s: FloatArray) -> FloatArray:
    """Stick work of a pilot [deg], shape (n,)."""
    return COMMANDS["hand_flown"](time_s, np.random.default_rng(seed))


def flown(seed: int, fault: Failure | None, time_s: FloatArray) -> FloatArray:
    """Measured deflection under that command [deg], shape (n,)."""
    command_deg = command(seed, time_s)
    faultless = MODEL.simulate(time_s, command_deg, time_s)
    deflection_deg = faultless if fault is None else fault.deflection(MODEL, time_s, command_deg, time_s)
    return deflection_deg + NOISE_DEG * np.random.default_rng([seed, 1]).standard_normal(time_s.size)


def without_spikes(time_s: FloatArray, command_deg: FloatArray, measured_deg: FloatArray) -> FloatArray:
    """Positions [deg] without those that are marked as spikes, shape (n,)."""
    none = np.zeros(time_s.size, dtype=np.int8)
    why, _ = marked(Rows(time_s, measured_deg, command_deg, none - 1, none))
    return np.where(why == Why.SPIKE, np.nan, measured_deg)


def troubled(servo: str) -> Series:
    """Twelve seconds with lost samples, a hole, a spike, which is marked, and commands that rest."""
    rng = np.random.default_rng(7)
    time_s = np.arange(600) / 50.0
    command_deg = command(5, time_s)
    command_deg[400:470] = command_deg[400]
    model = ServoModel.of(servo_named(servo))
    measured_deg = model.simulate(time_s, command_deg, time_s) + NOISE_DEG * rng.standard_normal(time_s.size)
    measured_deg[150] += 20.0
    measured_deg[520:] += 3.0
    measured_deg = without_spikes(time_s, command_deg, measured_deg)
    asked, seen = rng.random(time_s.size) > 0.1, rng.random(time_s.size) > 0.1
    seen[250:280] = asked[330:350] = False
    why = is_unsettled((time_s[asked], command_deg[asked]), time_s[seen], measured_deg[seen], time_s[seen]) * np.int8(
        Why.UNSETTLED
    )
    return Series("x", time_s[asked], command_deg[asked], time_s[seen], measured_deg[seen], why=why)


def residuals_of(time_s: FloatArray, command_deg: FloatArray, measured_deg: FloatArray) -> Residuals:
    """As the HS-225BB's model has them."""
    return GENERATOR.run(Series("x", time_s, command_deg, time_s, measured_deg))


def judged(
    time_s: FloatArray,
    command_deg: FloatArray,
    measured_deg: FloatArray,
    threshold: ThresholdKind = "constant",
    persistence: int = 1,
) -> Found:
    """Faults of a surface; a constant threshold is at 1.5 deg."""
    segment = Series("x", time_s, command_deg, time_s, measured_deg)
    changes = {"threshold": threshold, "persistence": persistence}
    surface = plain_aircraft(["x"], "hs225bb-eq31").surfaces["x"].model_copy(update=changes)
    return Healthy(surface, MODEL).beside(segment).found
