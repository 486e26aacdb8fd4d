"""A contact that comes and goes is one fault with its own name, whoever knows the servo."""

from __future__ import annotations

import numpy as np
import pytest

import servofd
from servofd.aircraft.schema import plain_aircraft
from servofd.core.statistics import Estimate
from servofd.detection.faults import _added
from servofd.detection.outages import held, outages_in
from servofd.detection.verdict import Fault
from servofd.servo.faults import Bias, Intermittent, failing_deflection
from servofd.simulation.flight import simulate_flight


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "servo"),
    [
        (11, "unknown"),
        (17, "hs225bb-eq31"),
        *(
            pytest.param(*each, marks=pytest.mark.nightly)
            for each in ((11, "hs225bb-eq31"), (15, "hs225bb-eq31"), (15, "unknown"), (17, "unknown"))
        ),
    ],
)
def test_it_has_its_name_and_nothing_else_is_at_fault(seed: int, servo: str) -> None:
    names = ["elevator", "rudder"]
    aircraft = plain_aircraft(names, "hs225bb-eq31")
    fault = {"elevator": Intermittent(40.0, outage_s=1.2, apart_s=3.0, seed=seed)}
    flown = simulate_flight(aircraft, faults=fault, duration_s=90.0, seed=seed, noise_deg=0.05)
    columns = {
        name: values
        for k, surface in enumerate(names)
        for name, values in (
            (f"{surface}_cmd_deg", flown.command_deg[:, k]),
            (f"{surface}_pos_deg", flown.measured_deg[:, k]),
        )
    }
    audit = servofd.audit({"time_s": flown.time_s, **columns}, servo=servo)
    assert isinstance(audit, servofd.Audit)
    assert audit["rudder"].status == "healthy"
    found = audit["elevator"].faults
    assert found[-1].kind == "intermittent"
    assert len(found) <= 2  # what the first look saw of it, and then what it is
    assert found[0].start_s > 39.9


def test_a_command_that_is_held_moves_the_servo_no_more() -> None:
    time_s = np.arange(0.0, 30.0, 0.02)
    command_deg = 10.0 * np.sin(1.5 * time_s)
    model = plain_aircraft(["rudder"], "s9254").model("rudder")
    fault = Intermittent(5.0, outage_s=1.0, seed=3)
    measured_deg = failing_deflection(model, [fault], time_s, command_deg, time_s)
    good_deg = failing_deflection(model, [], time_s, command_deg, time_s)
    error_deg = measured_deg - good_deg
    commands = (time_s, command_deg)
    found = outages_in(time_s, measured_deg, error_deg, np.full(time_s.size, 0.05), 0.02, commands, 0.02)
    assert len(found) >= 4
    arrived = held((time_s, command_deg, np.zeros(time_s.size)), found)
    explained_deg = measured_deg - failing_deflection(model, [], arrived[0], arrived[1], time_s)
    assert np.std(explained_deg) < 0.2 * np.std(error_deg)


def test_a_good_servo_has_no_outages() -> None:
    time_s = np.arange(0.0, 30.0, 0.02)
    command_deg = np.round(5.0 * np.sin(0.7 * time_s))
    sigma_deg = np.full(time_s.size, 0.1)
    found = outages_in(time_s, command_deg, np.zeros(time_s.size), sigma_deg, 0.05, (time_s, command_deg), 0.0)
    assert found == ()


def test_one_that_has_its_name_is_not_perhaps_what_it_is() -> None:
    """With two brief faults after it, each soon after the one before."""
    named = Fault("intermittent", 100.0, 110.0, 118.0, {"outage_s": Estimate.of(0.8, 0.2)}, 0.9, ("deadband",))
    jams = (Fault("stuck", at_s, at_s + 2.0, at_s + 2.5, {}, 0.9, ()) for at_s in (137.0, 148.0))
    faults: list[Fault] = []
    for fault in (named, *jams):
        faults, _ = _added(faults, fault, fault.alarm_s)
    (one,) = faults
    assert (one.kind, one.start_s, one.end_s, one.alternatives) == ("intermittent", 100.0, 150.5, ("deadband",))
    assert one.parameters["outage_s"].value == 2.5  # of 0.8, 2.5 and 2.5 s, and not of 18 s


@pytest.mark.slow
def test_what_comes_after_more_alarms_than_are_named_is_not_passed_over_in_silence(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    aircraft = plain_aircraft(["rudder"], "hs225bb-eq31")
    faults = {"rudder": tuple(Bias(at_s, end_s=at_s + 8.0, bias_deg=5.0) for at_s in (20.0, 50.0))}
    flown = simulate_flight(aircraft, faults=faults, duration_s=80.0, seed=1, noise_deg=0.05)
    columns = {"rudder_cmd_deg": flown.command_deg[:, 0], "rudder_pos_deg": flown.measured_deg[:, 0]}
    for most, many, is_cut in ((20, 2, False), (1, 1, True)):
        monkeypatch.setattr("servofd.detection.faults._MOST_FAULTS", most)
        audit = servofd.audit({"time_s": flown.time_s, **columns}, servo="hs225bb-eq31")
        assert isinstance(audit, servofd.Audit)
        assert len(audit["rudder"].faults) == many
        assert ("what came after 28 s was not looked at" in audit["rudder"].reason) == is_cut
