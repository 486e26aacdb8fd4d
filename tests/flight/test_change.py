"""One flight against its own past: flights of an aeroplane of another structure than the models."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest

import logparsers
from servofd.axes.motion import Motion
from servofd.axes.read import motion_of
from servofd.core.windows import Sizes
from servofd.flight.change import AxisChange, airborne, counted, judge_motion_alone
from servofd.simulation.airframe import AirframeFault, AirframeFlight, airframe_log, fly_airframe
from tests.axes.flights import flown


def motion_alone(flight: AirframeFlight) -> dict[str, AxisChange]:
    """Axes of a simulated aeroplane, from its log."""
    return judge_motion_alone(motion_of(logparsers.read(io.BytesIO(airframe_log(flight)))))


@pytest.mark.parametrize("seed", range(4))
def test_half_of_the_ailerons_is_missed_and_measured(seed: int) -> None:
    roll = judge_motion_alone(flown(seed, duration_s=180.0, aileron_share=0.5, from_s=100.0))["roll"]
    assert roll.status == "look"
    assert roll.since_s == pytest.approx(100.0, abs=5.0)
    assert roll.alarm_s is not None
    assert 100.0 < roll.alarm_s < 125.0
    assert roll.lost_share is not None
    assert roll.lost_share.low < 0.5 < roll.lost_share.high


@pytest.mark.slow
def test_healthy_flights_are_no_reason_to_look() -> None:
    looks = [
        axis.axis
        for seed in range(12)
        for axis in judge_motion_alone(flown(100 + seed, duration_s=180.0)).values()
        if axis.status == "look"
    ]
    assert looks == []


def test_the_verdict_uses_nothing_that_comes_later() -> None:
    flight = flown(3, duration_s=180.0, aileron_share=0.4, from_s=100.0)
    whole = judge_motion_alone(flight)["roll"]
    assert whole.alarm_s is not None
    cut = judge_motion_alone(flight.until(whole.alarm_s + 5.0))["roll"]
    assert cut.alarm_s == whole.alarm_s
    assert cut.lost_share == pytest.approx(whole.lost_share)


def test_a_flight_without_motion_is_unknown() -> None:
    calm = flown(5, duration_s=180.0)
    calm.commands_us["roll"][:] = np.random.default_rng(5).normal(0.0, 1.0, calm.time_s.size)
    assert judge_motion_alone(calm)["roll"].status == "unknown"
    short = judge_motion_alone(flown(5, duration_s=20.0))["roll"]
    assert short.status == "unknown"
    assert "40 s are needed" in short.text


def landed(flight: Motion, from_s: float) -> Motion:
    """The same flight, on the runway from a time on."""
    slow = np.where(flight.time_s >= from_s, 0.5, flight.airspeed_m_s)
    return replace(flight, airspeed_m_s=slow)


def test_what_comes_after_the_landing_is_not_judged() -> None:
    flight = landed(flown(7, duration_s=180.0, aileron_share=0.0, from_s=120.0), 120.0)
    flies, _ = airborne(flight)
    assert float(flight.time_s[flies][-1]) == pytest.approx(117.0, abs=0.2)
    roll = judge_motion_alone(flight)["roll"]
    assert roll.status != "look"
    assert roll.judged_until_s == pytest.approx(117.0, abs=1.5)


def test_two_flights_in_one_log_are_judged_without_the_ground_between() -> None:
    flight = flown(8, duration_s=240.0)
    ground = (flight.time_s > 110.0) & (flight.time_s < 130.0)
    flight = replace(flight, airspeed_m_s=np.where(ground, 0.0, flight.airspeed_m_s))
    flies, _ = airborne(flight)
    assert not flies[(flight.time_s > 107.5) & (flight.time_s < 134.5)].any()
    assert judge_motion_alone(flight)["roll"].status != "look"


def test_an_axis_in_which_one_jam_of_two_would_not_show_is_not_called_fine() -> None:
    flight = flown(1, duration_s=51.0)  # a loss of 56 % would show
    assert judge_motion_alone(replace(flight, members={"roll": ("aileron",)}))["roll"].status == "ok"
    assert judge_motion_alone(flight)["roll"].status == "unknown"


def test_a_small_offset_is_no_reason_to_believe_a_loss() -> None:
    sizes = Sizes(np.array([[0.33, 0.33, 0.0], [18.0, 30.0, 30.0]]), np.diag([0.2**2, 6.0**2])[..., None])
    at_most = (0.33 / 0.2) ** 2
    assert counted(sizes, sizes) == pytest.approx([at_most, at_most + 25.0, 25.0])


def followed_by(one: Motion, other: Motion) -> Motion:
    """One flight that goes on as another."""

    def both(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        return np.concatenate([first, second], axis=-1)

    return replace(
        one,
        time_s=both(one.time_s, other.time_s + one.time_s[-1]),
        commands_us={axis: both(values, other.commands_us[axis]) for axis, values in one.commands_us.items()},
        rates_deg_s=both(one.rates_deg_s, other.rates_deg_s),
        accelerations_m_s2=both(one.accelerations_m_s2, other.accelerations_m_s2),
        roll_deg=both(one.roll_deg, other.roll_deg),
        pitch_deg=both(one.pitch_deg, other.pitch_deg),
        airspeed_m_s=both(one.airspeed_m_s, other.airspeed_m_s),
        throttle=both(one.throttle, other.throttle),
        present=both(one.present, other.present),
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "rate_hz", "turbulence"), [(900, 25.0, 0.307), (913, 10.0, 0.616), (920, 10.0, 0.802), (915, 25.0, 0.529)]
)
def test_a_straight_leg_in_gusts_after_turns_is_no_loss(seed: int, rate_hz: float, turbulence: float) -> None:
    turns, leg = (
        fly_airframe(seed, rate_hz=rate_hz, turbulence=turbulence, duration_s=duration_s, manoeuvres=manoeuvres)
        for duration_s, manoeuvres in ((70.0, 1.0), (90.0, 0.05))
    )
    flight = followed_by(*(motion_of(logparsers.read(io.BytesIO(airframe_log(one)))) for one in (turns, leg)))
    assert [axis.text for axis in judge_motion_alone(flight).values() if axis.status == "look"] == []


CALM = ((207, 0.55), (239, 1.09), (215, 0.58), (223, 0.57), (283, 0.76), (289, 0.57))
"""Healthy flights that read "lost 63 % [-2, 128]" while sizes that mean nothing counted; the last four at night."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "turbulence"), [*CALM[:2], *(pytest.param(*each, marks=pytest.mark.nightly) for each in CALM[2:])]
)
def test_calm_healthy_flights_with_little_to_tell_are_no_reason_to_look(seed: int, turbulence: float) -> None:
    flight = fly_airframe(seed, turbulence=turbulence, duration_s=240.0)
    assert [axis.text for axis in motion_alone(flight).values() if axis.status == "look"] == []


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "value"), [("bias", 3.0), ("stuck", 10.0)])
def test_an_offset_is_no_loss_and_the_intervals_hold_the_truth(kind: str, value: float) -> None:
    surfaces = ("aileron_left", "aileron_right") if kind == "bias" else ("aileron_left",)
    true_us, true_loss = value / 0.05 * len(surfaces) / 2.0, 0.0 if kind == "bias" else 0.5
    found = []
    for seed in range(402, 418, 2):
        faults = tuple(AirframeFault(surface, kind, 110.0, value) for surface in surfaces)
        roll = motion_alone(fly_airframe(seed, turbulence=0.8, duration_s=140.0, faults=faults))["roll"]
        if roll.lost_share is not None and roll.offset_us is not None:
            found.append((roll.lost_share, roll.offset_us))
    assert len(found) >= 4
    assert sum(away.low < true_us < away.high for _, away in found) >= 0.75 * len(found)
    assert sum(lost.low < true_loss < lost.high for lost, _ in found) >= 0.75 * len(found)
    if kind == "bias":
        assert sum(lost.low > 0.0 for lost, _ in found) <= 0.25 * len(found)
