"""How well a servo calibrated on one good flight is judged, against one whose true numbers are known.

    python benchmarks/calibrated.py [SERVOS [FLIGHTS]]

Draws servos, calibrates each on one lively flight of 5 minutes, and judges the same faulty flights with three aircraft
files: as it was before, as calibrated, and with the servo's true numbers (and the tolerances of the calibration).
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fleet import KINDS, FleetFlight, FleetServo, any_servo, flight
from servofd.aircraft import Aircraft, plain_aircraft
from servofd.detection.judge import Judgement, judge
from servofd.detection.residual import ResidualGenerator
from servofd.segment import Segment
from servofd.workflow import calibrate

if TYPE_CHECKING:
    from collections.abc import Iterator

_MOTOR_DENOMINATOR = np.polymul([1.0, 24.84], [1.0, 70.04, 4921.0])
"""Thesis Eq. 3.1."""
_RATE_LIMIT_DEG_S = 370.0
"""Thesis Fig. 3.10."""
_LEARN_SEED, _LEARN_S = 1000, 300.0


class Score(NamedTuple):
    """One faulty flight."""

    right: bool
    delay_s: float
    false_alarms: int


def main() -> None:
    servos, flights = (int(text) for text in (*sys.argv[1:], *("12", "4")[len(sys.argv) - 1 :]))
    scores: dict[str, list[Score]] = {"before": [], "calibrated": [], "true": []}
    for number in range(servos):
        servo = any_servo(np.random.default_rng(number))
        learnt = _calibrated(servo)
        files = {"before": plain_aircraft(["x"]), "calibrated": learnt, "true": _true(servo, learnt)}
        for name, aircraft in files.items():
            scores[name] += _flown(servo, aircraft, range(100 * number, 100 * number + flights))
    print(f"{len(scores['true'])} faulty flights")
    print(f"{'aircraft file':<14}{'right names':>12}{'median delay':>14}{'false alarms':>14}")
    for name, each in scores.items():
        right, delay_s = np.mean([s.right for s in each]), np.median([s.delay_s for s in each])
        print(f"{name:<14}{right:>12.1%}{delay_s:>12.3f} s{sum(s.false_alarms for s in each):>14}")


def _calibrated(servo: FleetServo) -> Aircraft:
    log = flight(_LEARN_SEED, "lively", servo=servo, duration_s=_LEARN_S)
    table = np.column_stack([log.time_s, log.command_deg, log.measured_deg])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "good.csv"
        np.savetxt(path, table, "%.6f", ",", header="time_s,x_cmd_deg,x_pos_deg", comments="")
        return calibrate([path], plain_aircraft(["x"])).aircraft


def _true(servo: FleetServo, learnt: Aircraft) -> Aircraft:
    """The servo as it is, in the file's own words, with what the calibration allows and asks for."""
    order = np.arange(_MOTOR_DENOMINATOR.size)
    denominator = _MOTOR_DENOMINATOR * servo.bandwidth_scale**order
    document = learnt.model_dump(exclude_none=True)
    document["servos"] = {
        "true": {
            "title": "true", "numerator": [servo.gain * denominator[-1]], "denominator": denominator.tolist(),
            "delay_s": servo.delay_s, "hold": "zoh", "rate_limit_deg_s": _RATE_LIMIT_DEG_S, "source": "the fleet",
            "unity_dc": False,
        }
    }  # fmt: skip
    plain = plain_aircraft(["x"]).surfaces["x"]
    measured = plain.measured.model_dump() | {"trim_deg": servo.bias_deg} if plain.measured else None
    document["surfaces"]["x"] |= {"servo": "true", "command": plain.command.model_dump(), "measured": measured}
    return Aircraft.model_validate(document)


def _flown(servo: FleetServo, aircraft: Aircraft, seeds: range) -> Iterator[Score]:
    for seed in seeds:
        for kind in KINDS:
            log = flight(seed, "lively", kind, "medium", servo=servo)
            start_s = log.truth.start_s if log.truth else np.inf
            faults = _judged(log, aircraft).faults
            since = [fault for fault in faults if fault.alarm_s >= start_s]
            delay_s = since[0].alarm_s - start_s if since else np.inf
            yield Score(bool(since) and since[0].kind == kind, delay_s, len(faults) - len(since))


def _judged(log: FleetFlight, aircraft: Aircraft) -> Judgement:
    surface = aircraft.surfaces["x"].model_copy(update={"threshold": "interval"})
    measured_deg = surface.measured.to_deg(log.measured_deg) if surface.measured else log.measured_deg
    segment = Segment("x", log.time_s, surface.command.to_deg(log.command_deg), log.time_s, measured_deg)
    generator = ResidualGenerator.fitting(aircraft.model("x"), segment, surface.filter_pole_rad_s)
    return judge(generator, segment, generator.run(segment), surface)


if __name__ == "__main__":
    main()
