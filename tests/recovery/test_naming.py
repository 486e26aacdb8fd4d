"""Hidden faults come back with their name, onset and alarm, from servos that differ from the model."""

from __future__ import annotations

import numpy as np
import pytest

from bound import KNOWN_ONSET, UNKNOWN_ONSET
from fleet import KINDS, SIZES, STYLES
from trial import Case, trial

SEED = 1000
"""The benchmark flies seeds from 0 on."""


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_large_fault_gets_its_name(kind: str) -> None:
    one = trial(Case(SEED, "gusty", kind, "large"))
    assert one.name == kind
    assert one.alarms == 0
    assert one.found is not None
    # A geared servo without power stays where it is: of 47 that motor-level aircraft call stuck, 23 have none.
    assert one.probability > (0.85 if kind == "stuck" else 0.9)
    assert one.start_s <= one.found.alarm_s
    assert abs(one.onset_error_s) < 0.5
    # Nobody is faster than one who knows the fault, the onset and the noise.
    assert one.bound_delay_s(KNOWN_ONSET) <= one.bound_delay_s(UNKNOWN_ONSET) <= one.interval_delay_s
    # Three samples at 100 Hz, some of them lost, make an alarm of the interval threshold; one, of the constant one.
    assert one.interval_delay_s == one.bank_delay_s <= one.constant_delay_s + 0.05


def test_a_healthy_flight_has_no_fault_and_no_delay() -> None:
    one = trial(Case(SEED, "hand_flown", None, ""))
    assert (one.name, one.alarms, one.suspicions) == ("none", 0, 0)
    assert np.isinf([one.start_s, one.constant_delay_s, one.interval_delay_s, one.bound_delay_s(0.0)]).all()
    assert 0.1 < one.interval_peak < 1.0


@pytest.mark.nightly
def test_95_of_100_medium_and_large_faults_get_their_name() -> None:
    cases = [
        Case(seed, style, kind, size)
        for seed in range(SEED, SEED + 3)
        for style in STYLES
        for kind in SIZES
        for size in ("medium", "large")
    ]
    visible = [one for one in map(trial, cases) if one.enough_motion]
    wrong = [(one.case, one.name) for one in visible if not one.right]
    assert len(visible) > 100
    assert len(wrong) <= 0.05 * len(visible), wrong
    assert sum(one.alarms for one in visible) == 0


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [2, pytest.param(20, marks=pytest.mark.nightly)])
def test_no_false_alarm_in_healthy_flights(seeds: int) -> None:
    """A hundred at night."""
    flights = [trial(Case(SEED + n, style, None, "")) for n in range(seeds) for style in STYLES]
    assert [one.case for one in flights if one.alarms] == []
