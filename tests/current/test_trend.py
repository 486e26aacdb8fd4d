"""What a current tells over many flights: friction that grows, and nothing where nothing does."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from servofd.cli import main
from servofd.simulation.commands import gusty
from servofd.wear.series import SurfaceTrend
from servofd.wear.trend import trend_logs
from tests.current.motor import Sensor, fly


def written(folder: Path, name: str, seed: int, times: float) -> str:
    """A flight of 90 s whose gears rub `times` as much, known by its current alone."""
    command_deg = gusty(np.arange(0.0, 90.0, 0.04), np.random.default_rng(seed))
    fault = "binding" if times != 1.0 else ""
    flown = fly(90.0, seed, sensor=Sensor(10.0), fault=fault, start_s=0.0, times=times, command_deg=command_deg)
    path = folder / f"{name}.csv"
    path.write_text(flown.csv("aileron"))
    return str(path)


@pytest.fixture(scope="module")
def plane(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("good")
    logs = [written(folder, f"good{k}", 7000 + k, 1.0) for k in range(5)]
    assert main(["calibrate", *logs, "-o", str(folder / "plane.toml")]) == 0
    return str(folder / "plane.toml")


def followed(folder: Path, plane: str, friction: list[float], seed: int) -> SurfaceTrend:
    logs = [written(folder, f"flight{k:02d}", seed + k, times) for k, times in enumerate(friction)]
    (surface,) = trend_logs(logs, plane, workers=0).surfaces
    return surface


@pytest.mark.slow
def test_friction_that_grows_is_seen_in_the_current_of_motion(tmp_path: Path, plane: str) -> None:
    surface = followed(tmp_path, plane, [1.0 + 0.1 * k for k in range(12)], 8000)
    ratio = surface.quantities["current_ratio"]
    assert ratio.slope is not None
    assert ratio.slope.low > 0.0
    assert ratio.now.low > 1.3  # friction is 2.1 times that of the good flights
    assert ratio.forecast.kind == "reached"


@pytest.mark.slow
def test_good_flights_show_no_trend_and_their_intervals_hold(tmp_path: Path, plane: str) -> None:
    surface = followed(tmp_path, plane, [1.0] * 12, 9000)
    assert set(surface.quantities) == {"current_ratio", "current_spread_a", "idle_current_a"}
    assert not surface.alarms
    for one in surface.quantities.values():
        away = np.abs(one.flights.value - np.median(one.flights.value)) / one.flights.deviation
        assert np.mean(away < 1.96) >= 0.7  # 95 % in 30 flights; of 12 chance leaves out two or three
        assert np.mean(away < 0.5) <= 0.7  # nor are they wide for safety


@pytest.mark.slow
def test_flights_of_a_fleet_are_compared_by_what_their_servos_draw(
    tmp_path: Path, plane: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "logs").mkdir()
    for k, times in enumerate((1.0, 1.3)):
        written(tmp_path / "logs", f"flight{k}", 8500 + k, times)
    assert main(["audit", str(tmp_path / "logs"), "-c", plane, "-o", str(tmp_path / "results")]) == 0
    capsys.readouterr()
    assert main(["fleet", str(tmp_path / "results"), "--json", "-"]) == 0
    (surface,) = json.loads(capsys.readouterr().out)["surfaces"]
    low, high = surface["current_ratio"]
    assert 0.8 < low < 1.2
    assert high > low + 0.1
    assert "current / good flights" in (tmp_path / "results" / "fleet.html").read_text()
