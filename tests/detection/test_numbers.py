"""Numbers of an audit stay what they are: what changes them has to be meant.

Residuals, thresholds, hypotheses and odds of the same flights as they were recorded in `numbers.json`; where they
came from is proved elsewhere, here only that nobody moves them unawares, since verdicts of a fleet are compared over
years. ``python -m tests.detection.test_numbers`` records them anew.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from servofd.aircraft.schema import plain_aircraft
from servofd.core.types import FloatArray
from servofd.detection.bank import BANK, Explanation, Window, wandering
from servofd.detection.judge import judge, name_fault
from servofd.detection.probability import Noise, Wish, fit_tail, surface_odds
from servofd.detection.pulse import design_pulse_filter
from servofd.detection.residual import prepared
from servofd.servo.faults import Bias, DeadBand, Fault, Floating, LossOfEffectiveness, Oscillation, Slow, Stuck
from servofd.servo.library import servo_named
from tests.detection.windows import NOISE_DEG, troubled, window

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

STORED = Path(__file__).with_name("numbers.json")

FAULTS: dict[str, Fault | None] = {
    "healthy": None,
    "stuck": Stuck(2.0),
    "bias": Bias(2.0, bias_deg=2.5),
    "floating": Floating(2.0),
    "oscillation": Oscillation(2.0, amplitude_deg=2.0, frequency_hz=1.3),
    "dead band": DeadBand(2.0, width_deg=3.0),
    "slow": Slow(2.0, bandwidth_scale=0.3),
    "limited": Slow(2.0, rate_scale=0.1),
    "weak": LossOfEffectiveness(2.0, gain=0.6),
}
SERVOS = ("hs225bb-eq31", "s9254", "s3151")


def shaped(values: FloatArray) -> list[float]:
    """Mean, size, and weight at the end of an array: any sample that moves shows in one of them."""
    known = values[np.isfinite(values)]
    ramp = np.arange(known.size) / max(known.size, 1)
    return [float(known.size), float(known.mean()), float(np.sqrt(np.mean(known**2))), float(np.mean(ramp * known))]


def told(window: Window, other: Window, found: Explanation) -> dict[str, Any]:
    """Numbers of one explanation."""
    numbers: dict[str, Any] = {
        "cost_deg2": found.cost_deg2,
        "score": window.score(found),
        "doubt": found.doubt,
        "predicted_deg": shaped(found.predicted_deg),
        "parameters": {name: list(estimate) for name, estimate in found.parameters.items()},
    }
    if found.predict is not None:
        numbers["elsewhere_deg"] = shaped(found.predict(other))
    return numbers


def named(fault: str) -> dict[str, Any]:
    """What the bank makes of eight seconds of a fault."""
    seen, other = window(3, FAULTS[fault]), window(4, FAULTS[fault])
    found = {kind: e for kind, explain in {**BANK, "wandering": wandering}.items() if (e := explain(seen)) is not None}
    numbers: dict[str, Any] = {kind: told(seen, other, explanation) for kind, explanation in found.items()}
    numbers["probabilities"] = {k: p for k, p in name_fault(seen).probabilities.items() if p > 1e-3}
    return numbers


def judged(case: str) -> dict[str, Any]:
    """Residual, threshold and faults of a flight of such a servo, with such a threshold."""
    servo, kind = case.split()
    generator, raw = troubled(servo)
    surface = plain_aircraft(["x"], servo).surfaces["x"].model_copy(update={"threshold": kind})
    segment, residuals, notes = prepared(generator, raw)
    found = judge(generator, segment, residuals, surface)
    curves = {
        name: shaped(np.asarray(getattr(residuals, name), dtype=float))
        for name in ("simulated_deg", "measured_deg", "residual_deg", "immobile_deg", "settled", "restart")
    }
    curves |= {
        name: shaped(np.asarray(getattr(found.threshold, name), dtype=float))
        for name in ("level_deg", "tolerance_deg", "saturated_deg", "sigma_deg", "drift")
    }
    faults = [
        {
            "kind": fault.kind,
            "level": fault.level,
            "times_s": [fault.start_s, fault.alarm_s, fault.end_s, fault.named_s],
            "probability": fault.probability,
            "first_signs": list(fault.first_signs),
            "parameters": {name: list(estimate) for name, estimate in fault.parameters.items()},
        }
        for fault in found.faults
    ]
    return {"pole_rad_s": generator.pole_rad_s, "curves": curves, "faults": faults, "notes": list(notes)}


def odds(servo: str) -> dict[str, Any]:
    """Odds by the design of its filter, with and without a measured tail."""
    design = design_pulse_filter(servo_named(servo).transfer, 0.004, 0.01, 30.0)
    noise = Noise.designed(design, NOISE_DEG)
    sampled_deg = noise.sample((1, 800_000), 3)[0]
    measured = Noise.measured(sampled_deg, noise.sample_time_s, 20)
    tail = fit_tail(sampled_deg, noise.sample_time_s)
    found = surface_odds("x", servo, design, measured, 5.0 * noise.sigma_deg, Wish(1e-2, 1.0), tail=tail, hours=2.2)
    numbers: dict[str, Any] = {
        "noise": [measured.sigma_deg, measured.correlation, measured.long_run_factor, measured.mean_deg],
        "tail": [tail.peaks_per_hour, tail.lowest_rate_per_hour, tail.log_rate_error(0.4)],
        "gaussian_threshold_deg": found.gaussian_threshold_deg,
        "tail_threshold_deg": list(found.tail_threshold_deg or ()),
        "in_a_row_threshold_deg": found.in_a_row_threshold_deg,
        "cusum": [found.cusum.limit, found.cusum.factor, found.cusum_delay_s],
    }
    for name, point in (("in force", found.in_force), ("wished", found.wished)):
        numbers[name] = {
            "gaussian_per_hour": point.gaussian_per_hour,
            "tail_per_hour": list(point.tail_per_hour or ()),
            "in_a_row_per_hour": point.in_a_row_per_hour,
            "smallest_bias_deg": point.smallest_bias_deg,
            "delay_s": point.delay_s,
        }
    return numbers


RECORDED: dict[str, tuple[Callable[[str], dict[str, Any]], Iterable[str]]] = {
    "named": (named, FAULTS),
    "judged": (judged, [*(f"{servo} interval" for servo in SERVOS), "s9254 constant"]),
    "odds": (odds, SERVOS[:2]),
}
CASES = [(what, case) for what, (_, cases) in RECORDED.items() for case in cases]


def plain(numbers: Any) -> Any:
    """As JSON gives it back, infinity and keys that are numbers included."""
    return json.loads(json.dumps(numbers))


def assert_alike(found: Any, stored: Any, where: str) -> None:
    """The same up to 1e-4: searches end within 1e-6 on any machine, and no sign, factor or sample hides in that."""
    assert type(found) is type(stored), where
    if isinstance(stored, dict):
        assert list(found) == list(stored), where
        for key, value in stored.items():
            assert_alike(found[key], value, f"{where}/{key}")
    elif isinstance(stored, list):
        assert len(found) == len(stored), where
        for k, value in enumerate(stored):
            assert_alike(found[k], value, f"{where}/{k}")
    elif isinstance(stored, float):
        assert found == pytest.approx(stored, rel=1e-4, abs=1e-6, nan_ok=True), where
    else:
        assert found == stored, where


@pytest.mark.slow
@pytest.mark.parametrize(("what", "case"), CASES)
def test_numbers_are_those_that_were_recorded(what: str, case: str) -> None:
    assert_alike(plain(RECORDED[what][0](case)), json.loads(STORED.read_text())[what][case], f"{what}/{case}")


if __name__ == "__main__":
    everything = {what: {case: compute(case) for case in cases} for what, (compute, cases) in RECORDED.items()}
    STORED.write_text(json.dumps(everything, indent=1) + "\n")
