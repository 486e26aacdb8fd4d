"""The effect that is left of an axis over flights, where servos report nothing."""

from __future__ import annotations

from pathlib import Path

import pytest

from servofd.aircraft.axes import motion_to_toml
from servofd.aircraft.schema import load_aircraft
from servofd.axes.calibrate import calibrate_motion
from servofd.outputs.document import Section, Table
from servofd.outputs.page import html_page
from servofd.outputs.trend_report import trend_report
from servofd.wear.trend import trend_document, trend_logs
from tests.axes.flights import flown
from tests.axes.test_axes import as_table


@pytest.mark.slow
def test_an_axis_that_loses_effect_is_followed(tmp_path: Path) -> None:
    plane = tmp_path / "plane.toml"
    model = calibrate_motion([flown(seed, f"2026-05-0{1 + seed % 3}") for seed in range(3)])
    plane.write_text(motion_to_toml(model))
    logs = [
        as_table(tmp_path, f"2026-06-{k + 1:02d}.csv", flown(70 + k, aileron_share=1.0 - 0.06 * k, from_s=0.0))
        for k in range(9)
    ]
    seen = trend_logs(logs, load_aircraft(plane), workers=0)
    (roll,) = seen.surfaces
    effect = roll.quantities["effect"]
    assert set(roll.quantities) == {"effect", "offset_us"}
    assert effect.now.value == pytest.approx(0.52, abs=0.12)
    assert effect.slope is not None
    assert effect.slope.low < -0.06 < effect.slope.high
    assert effect.limit == 0.75
    document = trend_document(seen)
    (flights,) = [
        part for part in trend_report(document).parts if isinstance(part, Section) and part.title == "Flights"
    ]
    (table,) = [part for part in flights.parts if isinstance(part, Table)]
    effects = [str(row[-1]) for row in table.rows]
    assert float(effects[0].split()[0]) == pytest.approx(100.0, abs=15.0)
    assert float(effects[-1].split()[0]) == pytest.approx(52.0, abs=15.0)
    document["flights"][-1]["alarms"] = {"roll": "ailerons left and right lost half of the effect"}
    text = html_page(trend_report(document))
    assert "(2026-06-09.csv), roll: ailerons left and right lost half" in text
    assert "Servo: " not in text


@pytest.mark.slow
def test_an_axis_that_no_flight_tells_anything_of_has_its_page(tmp_path: Path) -> None:
    """Its command copied that of another axis: nothing to draw, and no word of servos."""
    plane, log = tmp_path / "plane.toml", as_table(tmp_path, "2026-06-01.csv", flown(70))
    model = calibrate_motion([flown(seed, f"2026-05-0{1 + seed % 3}") for seed in range(3)])
    axes = {name: axis.model_copy(update={"own_command": False}) for name, axis in model.axes.items()}
    plane.write_text(motion_to_toml(model.model_copy(update={"axes": axes})))
    seen = trend_logs([log, as_table(tmp_path, "2026-06-02.csv", flown(71))], load_aircraft(plane), workers=0)
    assert "never moved on its own" in html_page(trend_report(trend_document(seen)))
    assert all("dead_band_deg" not in surface.missing for surface in seen.surfaces)
