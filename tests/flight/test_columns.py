"""What one flight is judged by: settings that changed on the way, and airspeeds that measure nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from logparsers.records import Channel, FlightLog, Setting
from servofd.axes.motion import motion_of_autopilot
from servofd.flight.columns import flight_of
from servofd.flight.judge import judge_flight
from tests.axes.flights import flown
from tests.axes.test_bad_input import log_of


def changed(log: FlightLog, *settings: Setting) -> FlightLog:
    """A log in which settings became others; its parameters are the last, as every reader gives them."""
    return replace(log, parameters=dict(log.parameters) | {s.name: s.value for s in settings}, changed=settings)


def test_an_output_that_got_another_function_is_judged_by_the_one_that_it_had() -> None:
    log = log_of(flown(1, duration_s=200.0))
    whole = flight_of(log)
    swapped = flight_of(changed(log, Setting(150.0, "SERVO1_FUNCTION", 4.0, 0.0)))
    assert [one.name for one in swapped.outputs] == [one.name for one in whole.outputs]
    assert swapped.outputs[0].time_s[-1] <= 150.0
    assert swapped.motion is not None
    assert not swapped.motion.present[swapped.motion.time_s > 150.5].any()
    assert "SERVO1_FUNCTION changed while the log ran: nothing after 150 s was judged" in swapped.left_out
    on_the_ground = flight_of(changed(log, Setting(20.0, "SERVO1_FUNCTION", 0.0, 4.0)))
    assert on_the_ground.outputs[0].time_s[0] >= 20.0
    assert "nothing before 20 s" in on_the_ground.left_out


def test_a_trim_that_the_autopilot_moved_leaves_nothing_out_and_hides_no_asymmetry() -> None:
    log = log_of(flown(1, duration_s=200.0))
    moved = flight_of(changed(log, Setting(150.0, "SERVO1_TRIM", 1500.0, 1560.0)))
    assert moved.left_out == ""
    assert moved.outputs[0].trim == flight_of(log).outputs[0].trim


def test_a_setting_that_changed_before_the_log_or_before_take_off_is_as_it_was_flown() -> None:
    log = log_of(flown(1, duration_s=200.0))
    first_s, _ = log.ends_s
    before = flight_of(changed(log, Setting(first_s - 0.5, "SERVO1_REVERSED", 1.0, 0.0)))
    assert np.array_equal(before.outputs[0].values, flight_of(log).outputs[0].values)
    set_up = changed(log, Setting(10.0, "SERVO1_TRIM", 1900.0, 1500.0))
    assert flight_of(set_up).outputs[0].trim == pytest.approx(0.8)  # in flight: the autopilot's
    airspeed = log["CTUN.As"]
    taxis = replace(airspeed, values=np.where(airspeed.time_s < 20.0, 1.0, airspeed.values))
    on_the_ground = replace(set_up, channels={**set_up.channels, airspeed.name: taxis})
    assert flight_of(on_the_ground).outputs[0].trim == pytest.approx(0.0)


def with_pitot(log: FlightLog, airspeed_m_s: np.ndarray, time_s: np.ndarray) -> FlightLog:
    pitot = Channel("ARSP[0].Airspeed", time_s, airspeed_m_s, "m/s", "ARSP[0].Airspeed")
    return replace(log, channels={**log.channels, pitot.name: pitot})


def test_a_pitot_that_is_dead_or_gets_blocked_does_not_end_the_flight() -> None:
    flight = flown(1, duration_s=200.0)
    log = log_of(flight)
    noise = np.abs(np.random.default_rng(1).normal(0.0, 1.2, flight.time_s.size))
    good = motion_of_autopilot(with_pitot(log, flight.airspeed_m_s, flight.time_s))
    assert good.airspeed_source == "sensor"
    blocked = np.where(flight.time_s > 120.0, noise, flight.airspeed_m_s)
    for reading in (noise, blocked):
        motion = motion_of_autopilot(with_pitot(log, reading, flight.time_s))
        assert motion.airspeed_source == "the autopilot's estimate"
        assert motion.airspeed_m_s[-1] == pytest.approx(good.airspeed_m_s[-1])


def test_what_was_judged_is_said_from_when_until_when_and_what_would_not_show() -> None:
    found = judge_flight(log_of(flown(1, duration_s=200.0)))
    assert found is not None
    roll = found.axes["roll"]
    assert roll.status == "ok"
    assert roll.judged_from_s == pytest.approx(40.0, abs=1.5)
    assert f"judged from {roll.judged_from_s:.0f} to {roll.judged_until_s:.0f} s" in found.sentence
    for word in ("failed earlier", "near its trim", "a few degrees off", "slow"):
        assert word in found.sentence


def joined(first: FlightLog, second: FlightLog, ground_s: float) -> FlightLog:
    """Two flights in one log, the second take-off so long after the first landing."""
    later_s = first.ends_s[1] + ground_s
    stands = np.arange(first.ends_s[1] + 0.04, later_s, 0.04)
    channels = {}
    for name, one in first.channels.items():
        other = second.channels[name]
        still = np.full(stands.size, 0.0 if name == "CTUN.As" else one.values[-1])
        time_s = np.concatenate([one.time_s, stands, other.time_s + later_s])
        channels[name] = replace(one, time_s=time_s, values=np.concatenate([one.values, still, other.values]))
    return replace(first, channels=channels)


def test_of_two_flights_in_a_log_each_is_judged_by_itself_and_the_one_to_look_at_comes_first() -> None:
    healthy = log_of(flown(8, duration_s=150.0))
    failed = log_of(flown(9, duration_s=150.0, aileron_share=0.0, from_s=100.0))
    found = judge_flight(joined(healthy, failed, 40.0))
    assert found is not None
    assert found.sentence.startswith("flight 2 of 2 (in the air from 195 to ")
    assert "; flight 1 of 2 (in the air from 5 to 147 s): nothing looks wrong in roll" in found.sentence
    assert found.sentence.count("would not show") == 1
    roll = found.axes["roll"]
    assert roll.status == "look"
    alone = judge_flight(failed)
    assert alone is not None
    assert alone.axes["roll"].since_s is not None
    assert roll.since_s == pytest.approx(190.0 + alone.axes["roll"].since_s, abs=1.0)
    assert len(roll.score) == len(roll.time_s)
    assert np.isfinite(roll.score[60:140]).mean() > 0.9
    assert not np.isfinite(roll.score[192:225]).any()  # its own past begins on the ground


def test_what_was_trimmed_on_the_ground_is_no_reason_to_look() -> None:
    first = flown(8, duration_s=150.0)
    trimmed = flown(9, duration_s=150.0, trim_step_us=60.0, from_s=0.0)
    found = judge_flight(joined(log_of(first), log_of(trimmed), 40.0))
    assert found is not None
    assert found.axes["roll"].status == "ok"


def test_an_airspeed_that_dies_in_the_air_is_said_and_is_no_landing() -> None:
    log = log_of(flown(1, duration_s=200.0))
    airspeed = log["CTUN.As"]
    dies = replace(airspeed, values=np.where(airspeed.time_s > 120.0, 3.0, airspeed.values))
    found = judge_flight(replace(log, channels={**log.channels, dies.name: dies}))
    assert found is not None
    assert "from 120 to 200 s the airspeed reads 3 m/s though the aircraft banks" in found.sentence
    assert "nothing there was judged" in found.sentence
    assert "flight 2" not in found.sentence
