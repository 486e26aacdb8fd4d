"""PX4: surfaces by their control allocation, old topics, and a VTOL while it flies forward."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from logparsers.records import Channel, FlightLog
from servofd.axes.motion import Motion
from servofd.axes.read import motion_of
from servofd.core.errors import NoMeasurement
from servofd.flight.change import judge_motion_alone
from tests.axes.flights import flown


def log_of(flight: Motion, surfaces: dict[str, tuple[np.ndarray, int]], **more: np.ndarray) -> FlightLog:
    """A ULog of a flight, with its bank alone as attitude."""
    half = np.radians(flight.roll_deg) / 2.0
    columns: dict[str, np.ndarray] = {
        **{f"vehicle_angular_velocity[0].xyz[{k}]": np.radians(flight.rates_deg_s[k]) for k in range(3)},
        **{f"vehicle_acceleration[0].xyz[{k}]": flight.accelerations_m_s2[k] for k in range(3)},
        "vehicle_attitude[0].q[0]": np.cos(half),
        "vehicle_attitude[0].q[1]": np.sin(half),
        "vehicle_attitude[0].q[2]": 0.0 * half,
        "vehicle_attitude[0].q[3]": 0.0 * half,
        "airspeed_validated[0].true_airspeed_m_s": flight.airspeed_m_s,
        **{name: values for name, (values, _) in surfaces.items()},
        **{f"vtol_vehicle_status[0].{name}": values for name, values in more.items()},
    }
    channels = {name: Channel(name, flight.time_s, values, "", name) for name, values in columns.items()}
    kinds = {f"CA_SV_CS{k}_TYPE": float(kind) for k, (_, kind) in enumerate(surfaces.values()) if kind}
    return FlightLog(Path("a.ulg"), "ulog", channels, parameters=kinds, vehicle="fixed wing")


def servos(*parts: tuple[np.ndarray, int]) -> dict[str, tuple[np.ndarray, int]]:
    return {f"actuator_servos[0].control[{k}]": part for k, part in enumerate(parts)}


def test_ailerons_elevons_and_old_controls_ask_the_same_of_roll() -> None:
    flight = flown(4, duration_s=180.0, aileron_share=0.4, from_s=100.0)
    asked = flight.commands_us["roll"] / 500.0
    ways = [
        servos((-asked, 1), (asked, 2)),
        servos((0.2 - asked, 5), (0.2 + asked, 6)),
        {"actuator_controls_0[0].control[0]": (asked, 0)},
    ]
    for surfaces in ways:
        found = motion_of(log_of(flight, surfaces))
        asked_us = np.interp(
            flight.time_s + 0.04, found.time_s, found.commands_us["roll"]
        )  # the mean of the cell before
        assert np.corrcoef(asked_us[50:-50], flight.commands_us["roll"][50:-50])[0, 1] > 0.99
        assert np.std(asked_us) == pytest.approx(np.std(flight.commands_us["roll"]), rel=0.05)
        np.testing.assert_allclose(found.roll_deg, np.interp(found.time_s, flight.time_s, flight.roll_deg), atol=0.1)
        roll = judge_motion_alone(found)["roll"]
        assert roll.status == "look"
        assert roll.since_s == pytest.approx(100.0, abs=5.0)
        assert roll.explained_share is not None


def test_a_vtol_is_judged_where_it_flies_forward() -> None:
    flight = flown(5, duration_s=120.0)
    asked = flight.commands_us["roll"] / 500.0
    state = np.where(flight.time_s < 30.0, 3.0, 4.0)
    found = motion_of(log_of(flight, servos((-asked, 1), (asked, 2)), vehicle_vtol_state=state))
    assert found.lifted_share == pytest.approx(0.25, abs=0.01)
    assert not found.present[found.time_s < 29.9].any()


def test_a_log_without_surfaces_says_what_is_missing() -> None:
    with pytest.raises(NoMeasurement, match="CA_SV_CS"):
        motion_of(log_of(flown(6, duration_s=20.0), {}))
