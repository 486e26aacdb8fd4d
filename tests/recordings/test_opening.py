"""A recording opens where something happens: at the first alarm, or at the second that is explained worst."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import servofd
from servofd.outputs.explain_recording import _worst
from servofd.outputs.recording.write import save_recording


def layout_of(path: Path) -> dict[str, Any]:
    """Values of the layout inside a recording, by component; of the tabs, and of the axes that are linked."""
    from rerun.chunk import RrdReader

    reader = RrdReader(str(path))
    (store,) = reader.blueprints()
    values: dict[str, Any] = {}
    names: dict[str, str] = {}
    for chunk in reader.stream(store=store):
        batch = chunk.to_record_batch().to_pydict()
        place = str(chunk.entity_path)
        if "ContainerBlueprint:display_name" in batch:
            names[place.strip("/")] = batch["ContainerBlueprint:display_name"][0][0]
        if place == "/time_panel" or "ContainerBlueprint:active_tab" in batch or "5c0dca6a" in place:
            values |= {key: cells[0][0] for key, cells in batch.items() if ":" in key and cells[0]}
    return values | {"tab": names[values["ContainerBlueprint:active_tab"]]}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "shown_s"), [("rudder:stuck@100", (85.0, 145.0)), ("rudder:hardover@5", (0.0, 60.0))]
)
def test_an_audit_opens_at_its_first_alarm_on_the_tab_of_its_surface(
    fault: str, shown_s: tuple[float, float], tmp_path: Path
) -> None:
    flown = servofd.simulate(fault=fault, duration_s=160.0, seed=3)
    found = servofd.audit(flown, servo="hs225bb-eq31", surfaces=("rudder",))
    assert isinstance(found, servofd.Audit)
    (first,) = found.rudder.faults
    save_recording(found, tmp_path / "flight.rrd")
    layout = layout_of(tmp_path / "flight.rrd")
    assert layout["tab"] == "rudder"
    seen = layout["TimeAxis:view_range"]
    assert (seen["start"] / 1e9, seen["end"] / 1e9) == pytest.approx(shown_s, abs=0.5)
    marked = layout["TimePanelBlueprint:time_selection"]
    assert (marked["min"] / 1e9, marked["max"] / 1e9) == pytest.approx((first.start_s, first.alarm_s))


@pytest.mark.slow
def test_a_healthy_flight_opens_on_the_overview_of_all_of_it(tmp_path: Path) -> None:
    found = servofd.audit("sample_logs/faser_healthy_flight.mat", surfaces=("rudder",))
    assert isinstance(found, servofd.Audit)
    save_recording(found, tmp_path / "flight.rrd")
    layout = layout_of(tmp_path / "flight.rrd")
    assert layout["tab"] == "Overview"
    assert "TimePanelBlueprint:time_selection" not in layout


@pytest.mark.parametrize(
    ("start_s", "length_s", "worst_s", "shown_s"),
    [(0.0, 15.0, 7.0, None), (100.0, 60.0, 130.2, (120.5, 140.5)), (100.0, 60.0, 101.0, (100.0, 111.5))],
)
def test_an_explanation_opens_at_its_worst_second(
    start_s: float, length_s: float, worst_s: float, shown_s: tuple[float, float] | None
) -> None:
    time_s = start_s + np.arange(0.0, length_s, 0.02)
    error_deg = np.where(np.abs(time_s - worst_s - 0.3) < 0.2, 5.0, 0.1)
    record = SimpleNamespace(time_s=time_s, counts=np.ones(time_s.size, dtype=bool))
    found: Any = SimpleNamespace(record=record, selection=SimpleNamespace(nominal=SimpleNamespace(error_deg=error_deg)))
    assert _worst(found) == pytest.approx(shown_s) if shown_s else _worst(found) is None
