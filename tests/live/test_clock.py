"""The clock of a vehicle that flies for weeks: what overflows is no restart, and a restart is no overflow."""

from __future__ import annotations

import pytest

from logparsers.codec import Received
from servofd.live.clock import VehicleClock

WRAP_MS = 2**32


def beat(ms: int) -> Received:
    return Received("ATTITUDE", 1, 1, {"time_boot_ms": ms % WRAP_MS})


@pytest.mark.parametrize("late_s", [0.0, 0.8])
def test_milliseconds_that_overflow_go_on(late_s: float) -> None:
    clock, first_ms = VehicleClock(), WRAP_MS - 5_020  # no stamp is 0, which would mean none
    for k in range(200):
        made_s, delay_s = k * 0.05, late_s * (k % 3 == 1)
        assert clock.time_s(beat(first_ms + 50 * k), 100.0 + made_s + delay_s) == pytest.approx(
            first_ms * 1e-3 + made_s, abs=1e-6
        )
    assert clock.restarts == 0


def test_a_message_from_before_the_overflow_comes_late() -> None:
    clock, first_ms = VehicleClock(), WRAP_MS - 100
    made = [clock.time_s(beat(first_ms + ms), 100.0 + ms * 1e-3) for ms in (0, 50, 150, 200)]
    late = clock.time_s(beat(first_ms + 90), 100.25)
    after = clock.time_s(beat(first_ms + 260), 100.26)
    assert [round((at or 0.0) * 1e3) - first_ms for at in (*made, late, after)] == [0, 50, 150, 200, 90, 260]


@pytest.mark.parametrize("up_s", [1_000.0, 2.0**32 * 1e-3 - 3.0, 6e6])
def test_a_restart_is_told_however_long_it_flew(up_s: float) -> None:
    clock, up_ms = VehicleClock(), round(up_s * 1e3)
    for k in range(100):
        clock.time_s(beat(up_ms + 50 * k), 100.0 + 0.05 * k)
    times = [clock.time_s(beat(40 + 50 * k), 205.0 + 0.05 * k) for k in range(10)]
    assert clock.restarts == 1
    assert times[-1] == pytest.approx(0.49, abs=1e-6)


def test_a_falling_delay_is_no_restart() -> None:
    """A link that was 3 s late delivers at once from 20 s on, and what was on its way still comes between."""
    clock, made = VehicleClock(), [0.05 * k for k in range(800)]
    arrivals = [(100.0 + at_s + (3.0 if at_s < 20.0 else 0.1), at_s) for at_s in made if at_s < 20.0 or at_s > 20.5]
    for arrival_s, at_s in sorted(arrivals):
        found_s = clock.time_s(beat(100_000 + round(1e3 * at_s)), arrival_s)
        assert found_s is None or found_s == pytest.approx(100.0 + at_s, abs=1e-6)
    assert clock.restarts == 0


def test_what_the_boot_before_sent_is_not_taken_for_the_new_one() -> None:
    """Frames of the old boot come for 2 s after the new one has begun: one restart, and times from its zero."""
    clock, found = VehicleClock(), []
    for k in range(200):
        clock.time_s(beat(100_000 + 50 * k), 100.0 + 0.05 * k)
    for k in range(200):
        arrival_s = 115.0 + 0.05 * k
        found.append(clock.time_s(beat(40 + 50 * k), arrival_s))
        if k > 10 and arrival_s < 117.0:
            assert clock.time_s(beat(110_000 + 50 * k), arrival_s + 0.01) is None
    assert clock.restarts == 1
    assert found[-1] == pytest.approx(9.99, abs=1e-6)


def test_a_clock_that_went_back_is_followed_after_a_while() -> None:
    """A log that is replayed once more begins neither at a boot nor soon after the time that was heard last."""
    clock = VehicleClock()
    for _ in range(2):
        for k in range(400):
            clock.time_s(beat(100_000 + 50 * k), 100.0 + 0.05 * k + 20.0 * clock.restarts)
    assert clock.restarts <= 1
    for k in range(400, 800):
        found_s = clock.time_s(beat(100_000 + 50 * (k - 400)), 100.0 + 0.05 * k)
    assert found_s == pytest.approx(119.95, abs=1e-6)


@pytest.mark.slow
def test_microseconds_overflow_every_71_minutes() -> None:
    clock = VehicleClock()
    for k in range(0, 90_000, 5):
        clock.time_s(beat(1000 + 1000 * k), 10.0 + k)
        stamp = Received("SERVO_OUTPUT_RAW", 1, 1, {"time_usec": (1_000_000 * k + 1_020_000) % 2**32})
        assert clock.time_s(stamp, 10.03 + k) == pytest.approx(1.02 + k, abs=1e-6)


def test_what_bears_no_stamp_goes_with_any_stamp_of_the_autopilot() -> None:
    """A link of pulses and airspeed alone: the airspeed stood still a second after the first message."""
    clock, first_us = VehicleClock(), 7_000_000
    for k in range(400):
        at_s = 0.1 * k
        pulses = Received("SERVO_OUTPUT_RAW", 1, 1, {"time_usec": first_us + round(1e6 * at_s)})
        made_s = clock.time_s(pulses, 100.0 + at_s)
        airspeed_s = clock.time_s(Received("VFR_HUD", 1, 1, {"airspeed": 20.0}), 100.02 + at_s)
        if k:  # the first one says how late the link is
            assert made_s == pytest.approx(7.0 + at_s, abs=1e-6)
            assert airspeed_s == pytest.approx(7.0 + at_s, abs=1.1)
