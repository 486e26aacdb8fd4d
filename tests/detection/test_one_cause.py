"""What befalls all servos at one instant is one cause; what befalls one while others are silent is its own."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

import servofd
from servofd.aircraft.schema import plain_aircraft
from servofd.core.types import BoolArray
from servofd.detection.verdict import SurfaceAudit

NAMES, SIZES_DEG = ("aileron", "elevator", "rudder"), (10.0, 1.5, 1.5)
TIME_S = np.arange(0.0, 40.0, 0.02)


def audited(frozen: dict[str, BoolArray], silent: dict[str, BoolArray]) -> dict[str, SurfaceAudit]:
    """Verdicts on three surfaces, of which one moves briskly, that freeze or are silent at some times."""
    rng, columns, model = np.random.default_rng(2), {}, plain_aircraft(["x"], "hs225bb-eq31").model("x")
    for k, (name, size_deg) in enumerate(zip(NAMES, SIZES_DEG, strict=True)):
        command_deg = size_deg * np.sin((1.9 + 0.4 * k) * TIME_S) + 0.3 * size_deg * np.sin(4.1 * TIME_S)
        measured_deg = model.simulate(TIME_S, command_deg, TIME_S) + rng.normal(0.0, 0.05, TIME_S.size)
        rows = np.arange(TIME_S.size)
        stays = frozen.get(name, np.zeros(TIME_S.size, dtype=bool))
        measured_deg = measured_deg[np.maximum.accumulate(np.where(stays, 0, rows))]
        columns[f"{name}_cmd_deg"] = command_deg
        columns[f"{name}_pos_deg"] = np.where(silent.get(name, False), np.nan, measured_deg)
    result = servofd.audit(pd.DataFrame({"time_s": TIME_S, **columns}), servo="hs225bb-eq31")[0]
    return {surface.surface: surface for surface in result.surfaces}


FREEZE = (TIME_S >= 20.0) & (TIME_S < 23.0)


@pytest.mark.slow
@pytest.mark.parametrize("others", ["stand still", "fall silent"])
def test_a_frozen_bus_accuses_nobody(others: str) -> None:
    quiet = dict.fromkeys(NAMES[1:], FREEZE)
    frozen = {"aileron": FREEZE} | (quiet if others == "stand still" else {})
    verdicts = audited(frozen, quiet if others == "fall silent" else {})
    assert verdicts["aileron"].faults == ()
    if others == "stand still":
        assert verdicts["aileron"].status == "healthy"
        assert "3.0 s of frozen telemetry not judged" in verdicts["aileron"].reason
        return
    assert verdicts["aileron"].status == "suspect"
    assert "3 surfaces left their models together" in verdicts["aileron"].reason
    assert "their positions stand still" in verdicts["aileron"].reason


@pytest.mark.parametrize("silent_s", [(0.0, 10.0), (15.0, 40.0), (np.inf, np.inf)])
def test_a_jam_is_its_own_whatever_the_others_do(silent_s: tuple[float, float]) -> None:
    others = dict.fromkeys(NAMES[1:], (silent_s[0] <= TIME_S) & (silent_s[1] > TIME_S))
    (fault,) = audited({"aileron": TIME_S >= 20.0}, others)["aileron"].faults
    assert fault.kind == "stuck"
    assert fault.start_s == pytest.approx(20.0, abs=0.6)
