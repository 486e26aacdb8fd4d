"""A servo bus that froze, told from servos that stand still."""

from __future__ import annotations

import numpy as np
import pytest

from servofd.aircraft.calibration import PulseCalibration
from servofd.live.vehicle import ServoBus

NAMES = ("aileron_1", "elevator_2", "rudder_4", "aileron_9")
PULSE = PulseCalibration(channel="x", unit="us", trim_us=1500.0, slope_deg_per_us=0.2)
REFRESH_S = 0.045
"""How often the bus asks each servo."""


def old(
    *, sent_s: float, frozen: tuple[float, float] = (0.0, 0.0), jammed: int | None = None, rest: tuple[int, ...] = ()
) -> dict[str, list[float]]:
    """When readings were old ones, in 20 s of slow waves; servos are read less often than that is sent."""
    bus = ServoBus.of(dict.fromkeys(NAMES, PULSE))
    rng = np.random.default_rng(3)
    found: dict[str, list[float]] = {name: [] for name in NAMES}
    readings: dict[tuple[int, float | str], float] = {}
    for k in range(round(20.0 / sent_s)):
        at_s = k * sent_s
        refreshed_s = REFRESH_S * np.floor(at_s / REFRESH_S)
        for i, name in enumerate(NAMES):
            asked_deg = 0.0 if i in rest else 15.0 * np.sin(0.9 * (1.0 + 0.3 * i) * at_s)
            bus.ask(name, 1500.0 + asked_deg / 0.2)
            key: tuple[int, float | str] = (i, refreshed_s)
            moves = i not in rest and not frozen[0] <= at_s < frozen[1] and not (i == jammed and at_s > 8.0)
            if key not in readings and (moves or (i, "now") not in readings):
                readings[key] = readings[i, "now"] = round(asked_deg + rng.normal(0.0, 0.05), 2)
            if bus.is_old(name, at_s, readings[i, "now"]):
                found[name].append(at_s)
    return found


@pytest.mark.parametrize("sent_s", [0.1, 0.05, 0.04, 0.02, 0.01])
def test_readings_that_are_sent_more_often_than_refreshed_are_news(sent_s: float) -> None:
    assert old(sent_s=sent_s) == {name: [] for name in NAMES}


@pytest.mark.parametrize("sent_s", [0.05, 0.02])
def test_a_frozen_bus_is_known_within_a_quarter_of_a_second_and_until_it_is_back(sent_s: float) -> None:
    for times_s in old(sent_s=sent_s, frozen=(9.0, 11.0)).values():
        assert 9.0 < times_s[0] <= 9.25
        assert 10.9 <= times_s[-1] < 11.1
        assert np.diff(times_s).max() == pytest.approx(sent_s)


@pytest.mark.parametrize("rest", [(), (2, 3), (1, 2, 3)])
def test_a_servo_that_jams_is_none(rest: tuple[int, ...]) -> None:
    """Whether the others move or rest: one that is asked alone cannot tell of the bus."""
    assert old(sent_s=0.04, jammed=0, rest=rest) == {name: [] for name in NAMES}


def test_servos_at_rest_are_none() -> None:
    assert old(sent_s=0.04, rest=(0, 1, 2, 3)) == {name: [] for name in NAMES}
