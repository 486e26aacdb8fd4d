"""The pre-flight check as JSON: schema ``servofd.sweep/1``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence

    from logparsers.records import FlightLog
    from servofd.detection.bank.explanation import Estimate
    from servofd.sweep.check import SurfaceSweep
    from servofd.sweep.numbers import SweepNumbers


def sweep_document(log: FlightLog, surfaces: Sequence[SurfaceSweep]) -> dict[str, Any]:
    """All numbers of one sweep.

    Examples
    --------
    >>> import logparsers
    >>> from servofd.aircraft import load_aircraft
    >>> from servofd.sweep.check import check_sweep
    >>> log = logparsers.read("sample_logs/faser_healthy_chirp.mat")
    >>> document = sweep_document(log, check_sweep(log, load_aircraft("faser"), ("aileron_right",)))
    >>> document["schema"], document["surfaces"]["aileron_right"]["status"]
    ('servofd.sweep/1', 'go')
    """
    return {
        "schema": "servofd.sweep/1",
        "path": str(log.source),
        "duration_s": log.duration_s,
        "surfaces": {
            one.surface: {
                "status": one.status,
                "reasons": list(one.reasons),
                "numbers": None if one.numbers is None else _numbers(one.numbers),
            }
            for one in surfaces
        },
    }


def _numbers(numbers: SweepNumbers) -> dict[str, Any]:
    return {
        "asked_deg": list(numbers.asked_deg),
        "expected_deg": list(numbers.expected_deg),
        "reached_deg": list(numbers.reached_deg),
        "gain": _estimate(numbers.gain),
        "extra_delay_s": _estimate(numbers.extra_delay_s),
        "bandwidth_scale": _estimate(numbers.bandwidth),
        "bias_deg": _estimate(numbers.bias_deg),
        "play_deg": _estimate(numbers.play_deg),
        "fastest_deg_s": numbers.fastest_deg_s,
        "residual_peak_deg": numbers.residual_peak_deg,
        "threshold_deg": numbers.threshold_deg,
    }


def _estimate(estimate: Estimate) -> dict[str, float]:
    return {"value": estimate.value, "low": estimate.low, "high": estimate.high}
