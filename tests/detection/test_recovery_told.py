"""A fault that goes away is told to be over within two seconds, and not before."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from servofd.aircraft.schema import Aircraft, plain_aircraft
from servofd.aircraft.series import Series
from servofd.calibrating.calibrate import calibrate_aircraft
from servofd.core.types import FloatArray
from servofd.detection.event import Event, Quiet
from servofd.detection.faults import Named, judged, watched_segment
from servofd.detection.flights import Flight
from servofd.detection.monitor import SurfaceMonitor
from servofd.detection.seen import Healthy

BEGINS_S, ENDS_S, LAST_S = 20.0, 32.0, 44.0
WITHIN_S = 2.0
KINDS = ("stuck", "bias", "slow", "hardover", "floating", "loss", "deadband")


def some(*often: str) -> list[Any]:
    """All kinds, of which these fail in every run."""
    return [pytest.param(kind, marks=[] if kind in often else pytest.mark.nightly) for kind in KINDS]


def faulty(kind: str, seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Time [s], command and measured deflection [deg] of a surface that is at fault for 12 s."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, LAST_S, 0.02)
    waves = ((6.0, 1.3), (4.0, 3.3), (3.0, 6.9))
    command_deg = np.sum([a * np.sin(w * time_s + rng.uniform(0.0, 6.0)) for a, w in waves], axis=0)
    command_deg = command_deg + 5.0 * np.sign(np.sin(0.7 * time_s + rng.uniform(0.0, 6.0)))
    healthy_deg = plain_aircraft(["x"], "hs225bb-eq31").model("x").simulate(time_s, command_deg, time_s)
    measured_deg, on = healthy_deg.copy(), (time_s >= BEGINS_S) & (time_s < ENDS_S)
    first, behind = np.flatnonzero(on)[[0, -1]] + (0, 1)
    here_s, here_deg = time_s[on], healthy_deg[on]
    followed_deg = np.empty((2, here_s.size))
    at_deg = np.full(2, healthy_deg[first])
    for k, wanted_deg in enumerate(here_deg):
        at_deg[0] += np.clip(0.06 * (wanted_deg - at_deg[0]), -1.0, 1.0)
        at_deg[1] = np.clip(at_deg[1], wanted_deg - 2.5, wanted_deg + 2.5)
        followed_deg[:, k] = at_deg
    measured_deg[on] = {
        "stuck": np.full(here_s.size, healthy_deg[first]),
        "hardover": np.full(here_s.size, 20.0),
        "floating": 2.0 * np.sin(0.8 * here_s),
        "bias": here_deg + 4.0,
        "loss": 0.5 * here_deg,
        "oscillation": here_deg + 3.0 * np.sin(2.0 * np.pi * 3.0 * here_s),
        "slow": followed_deg[0],
        "deadband": followed_deg[1],
    }[kind]
    back_deg = measured_deg[behind - 1]
    for k in range(behind, behind + 50):
        back_deg += np.clip(healthy_deg[k] - back_deg, -5.0, 5.0)
        measured_deg[k] = back_deg
    return time_s, command_deg, measured_deg + 0.05 * rng.standard_normal(time_s.size)


def told(kind: str, seed: int, calibrated: Aircraft | None = None) -> list[Event]:
    aircraft = calibrated or plain_aircraft(["x"], "hs225bb-eq31")
    entry = aircraft.surfaces["x"].model_copy(update={"threshold": "interval"})
    monitor, events = SurfaceMonitor("x", entry, aircraft.model("x")), []
    time_s, command_deg, measured_deg = faulty(kind, seed)
    for k in range(0, time_s.size, 2):
        here = slice(k, k + 2)
        events += monitor.feed((time_s[here], command_deg[here]), (time_s[here], measured_deg[here]))
        look = monitor.due()
        if look is not None:
            events += monitor.events_of(look, look.find())
    return events


@pytest.mark.slow
@pytest.mark.parametrize("kind", some("stuck"))
def test_the_end_of_a_fault_is_told_within_two_seconds_and_no_name_after_it(kind: str) -> None:
    events = told(kind, 6)
    (alarm,) = [event for event in events if event.event == "alarm"]
    (clear,) = [event for event in events if event.event == "clear"]
    assert BEGINS_S <= alarm.time_s < BEGINS_S + 1.0
    assert ENDS_S <= clear.time_s <= ENDS_S + WITHIN_S
    named = [event.time_s for event in events if event.event == "named"]
    assert named
    assert max(named) <= alarm.time_s + WITHIN_S


@pytest.fixture(scope="module")
def by_good_flights() -> Aircraft:
    """What comes before the fault in two other flights."""
    flights = []
    for seed in (1, 2):
        time_s, command_deg, measured_deg = (column[: round(BEGINS_S / 0.02)] for column in faulty("bias", seed))
        flights.append(Flight(f"{seed}.csv", Series("x", time_s, command_deg, time_s, measured_deg)))
    return calibrate_aircraft(plain_aircraft(["x"], "hs225bb-eq31"), {"x": flights}).aircraft


@pytest.mark.parametrize("kind", ["stuck", "hardover"])
def test_a_surface_on_its_way_back_is_not_renamed(by_good_flights: Aircraft, kind: str) -> None:
    """It was jammed, then it moved again: together these were a surface that moves by itself, for a second."""
    known = by_good_flights.surfaces["x"].calibrated
    assert known is not None
    columns = faulty(kind, 1)
    names: dict[float, Named] = {}

    def seen(until_s: float, before: dict[float, Named]) -> list[str]:
        time_s, command_deg, measured_deg = (column[: round(until_s / 0.02)] for column in columns)
        watched = watched_segment(known, Series("x", time_s, command_deg, time_s, measured_deg))
        return [fault.kind for fault in judged(watched, before).faults]

    assert seen(BEGINS_S + 2.5, names) == [kind]
    for late_s in np.arange(0.3, 2.0, 0.2):
        assert seen(ENDS_S + float(late_s), dict(names)) == [kind]


@pytest.mark.slow
@pytest.mark.parametrize("kind", some("slow"))
def test_a_calibrated_servo_is_no_longer_at_fault_two_seconds_after_it(by_good_flights: Aircraft, kind: str) -> None:
    events = [event for event in told(kind, 6, by_good_flights) if event.event in ("alarm", "clear")]
    assert BEGINS_S <= events[0].time_s < BEGINS_S + 1.0
    assert events[-1].event == "clear"
    assert ENDS_S - 1.5 <= events[-1].time_s <= ENDS_S + WITHIN_S
    time_s, command_deg, measured_deg = faulty(kind, 6)
    healthy = Healthy(by_good_flights.surfaces["x"], by_good_flights.model("x"))
    audited = healthy.beside(Series("x", time_s, command_deg, time_s, measured_deg))
    assert audited.found.faults[0].alarm_s == pytest.approx(events[0].time_s, abs=0.05)


def test_looks_in_vain_become_rarer() -> None:
    quiet, looked_s = Quiet(), []
    for k in range(600):
        at_s = 0.1 * k
        if k % 30 == 0:
            quiet.since_s = at_s
        looked_s += quiet.due_s(at_s)
    assert np.diff(looked_s)[:2].min() >= 0.4
    assert np.diff(looked_s)[4:].min() >= 1.5 - 1e-9
