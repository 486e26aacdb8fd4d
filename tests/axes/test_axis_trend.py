"""The effect that is left of an axis over flights, where servos report nothing."""

from __future__ import annotations

from pathlib import Path

import pytest

from servofd.aircraft.axes import motion_to_toml
from servofd.aircraft.schema import load_aircraft
from servofd.axes.calibrate import calibrate_motion
from servofd.wear.trend import trend_logs
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
    (roll,) = trend_logs(logs, load_aircraft(plane), workers=0).surfaces
    effect = roll.quantities["effect"]
    assert set(roll.quantities) == {"effect", "offset_us"}
    assert effect.now.value == pytest.approx(0.52, abs=0.12)
    assert effect.slope is not None
    assert effect.slope.low < -0.06 < effect.slope.high
    assert effect.limit == 0.75
