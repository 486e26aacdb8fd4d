"""A recording opens where something happens: at the first alarm, or at the second that is explained worst."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from servofd.outputs.identify_recording import _worst
from servofd.outputs.recording.layout import _first_alarm


def recorded(end_s: float, *alarms_s: float) -> Any:
    faults = [SimpleNamespace(start_s=alarm_s - 2.0, alarm_s=alarm_s) for alarm_s in alarms_s]
    audit = SimpleNamespace(surfaces=[SimpleNamespace(faults=faults[:1]), SimpleNamespace(faults=faults[1:])])
    return SimpleNamespace(audit=audit, start_s=0.0, end_s=end_s)


@pytest.mark.parametrize(
    ("end_s", "alarms_s", "shown_s"),
    [
        (600.0, [], None),
        (50.0, [20.0], None),
        (600.0, [306.0, 100.0], (83.0, 143.0)),
        (600.0, [5.0], (0.0, 60.0)),
        (600.0, [598.0], (581.0, 600.0)),
    ],
)
def test_an_audit_opens_at_its_first_alarm(
    end_s: float, alarms_s: list[float], shown_s: tuple[float, float] | None
) -> None:
    assert _first_alarm(recorded(end_s, *alarms_s)) == shown_s


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
