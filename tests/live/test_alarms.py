"""Laws of what is published, on any stream of what a detector may say."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servofd.core.statistics import Estimate
from servofd.detection.event import Event
from servofd.detection.verdict import Fault
from servofd.live.alarms import Alarms

KINDS = ("stuck", "slow", "bias", "unknown")


@st.composite
def events(draw: st.DrawFn) -> list[Event]:
    """Alarms, names and clears of two surfaces in the order of time, with faults whose onsets move, or without."""
    found, at_s = [], 0.0
    for _ in range(draw(st.integers(0, 30))):
        at_s += draw(st.floats(0.01, 5.0))
        what: Any = draw(st.sampled_from(("alarm", "named", "clear")))
        kind, surface = draw(st.sampled_from(KINDS)), draw(st.sampled_from(("rudder", "elevator")))
        fault = None
        if draw(st.booleans()):
            start_s = at_s - draw(st.floats(0.0, 20.0))
            end_s = draw(st.none() | st.just(at_s))
            fault = Fault(
                kind, start_s, min(start_s + 0.3, at_s), end_s, {"bias_deg": Estimate(9.0, 8.0, 10.0)}, 0.9, ()
            )
        found.append(Event(at_s, surface, what, kind, draw(st.floats(-30.0, 30.0)), 1.5, fault=fault))
    return found


@pytest.mark.slow
@given(events(), st.integers(0, 30))
@settings(max_examples=80, deadline=None)
def test_each_alarm_begins_and_ends_once(seen: list[Event], boots_after: int) -> None:
    """Names and clears carry the id of an alarm that stands, and a clear its name; a boot leaves none standing."""
    alarms, open_, ids, names = Alarms(1), {}, set(), {}
    told = alarms.publish(seen[:boots_after])
    told += alarms.begin_anew(Event(0.0, "", "no_data", text="vehicle 1 has restarted"))
    told += alarms.publish(seen[boots_after:])
    for event in told:
        if event.event == "alarm":
            assert event.id not in ids
            ids.add(event.id)
            open_[event.id], names[event.id] = event.surface, event.kind
        elif event.event in ("named", "clear"):
            assert open_[event.id] == event.surface
            if event.event == "clear":
                assert event.kind == names[event.id]
                del open_[event.id]
            names[event.id] = event.kind
        else:
            assert open_ == {}, "what stood has ended with the boot"
    assert {alarm.id for alarm in alarms.all if alarm.end_s is None} == set(open_)


@given(st.lists(st.floats(-0.9, 0.9), min_size=1, max_size=20))
@settings(max_examples=50, deadline=None)
def test_an_onset_that_moves_is_the_same_alarm(moves_s: list[float]) -> None:
    """However often a look puts the onset of one fault elsewhere, also after it was alarmed without a name."""
    alarms = Alarms(1)
    seen = [Event(10.0, "rudder", "alarm", "unknown", 3.0, 1.5)]
    for k, move_s in enumerate(moves_s):
        fault = Fault(KINDS[k % 3], 10.0 + move_s, 10.0 + abs(move_s), None, {}, 0.9, ())
        seen.append(Event(11.0 + k, "rudder", "alarm", fault.kind, 3.0, 1.5, fault=fault))
    told = alarms.publish(seen)
    assert [event.event for event in told].count("alarm") == 1
    assert {event.id for event in told} == {"1/rudder/1"}


def test_what_was_taken_back_is_reported_when_it_comes_again() -> None:
    """An offset that grows was one that a working servo may have at first, and then said nothing up to 8 deg."""
    offset = Fault("bias", 31.1, 32.5, None, {}, 0.9, ())
    alarms = Alarms(1)
    first = alarms.publish([Event(32.5, "rudder", "alarm", "bias", 0.4, 1.9, fault=offset)])
    assert [event.event for event in first] == ["alarm"]
    assert [event.event for event in alarms.publish([Event(34.5, "rudder", "clear", "healthy")])] == ["clear"]
    (again,) = alarms.publish([Event(38.7, "rudder", "alarm", "bias", 1.5, 1.9, fault=offset)])
    assert (again.event, again.id) == ("alarm", "1/rudder/2")


@pytest.mark.parametrize("last", ["named", "clear"])
def test_what_is_seen_of_a_fault_only_after_its_alarm_does_not_move_its_onset(last: str) -> None:
    """A jam that its current showed at 50 s, and its position, which was away, from 65.5 s on."""
    alarms = Alarms(1)
    jam = Fault("stuck", 50.1, 51.9, None, {}, 0.9, (), witness="current")
    alarms.publish([Event(51.9, "rudder", "alarm", "stuck", fault=jam)])
    again = replace(jam, kind="slow", start_s=65.5, alarm_s=66.0, witness="position")
    alarms.publish([Event(66.0, "rudder", "named", "slow", fault=again)])
    ended = replace(again, end_s=80.0)
    what: Any = last
    (told,) = alarms.publish([Event(80.0, "rudder", what, "slow" if last == "clear" else "stuck", fault=ended)])
    assert told.fault is not None
    assert (told.event, told.fault.start_s, alarms.all[0].since_s) == (last, 50.1, 50.1)
