"""From an alarm to blocks of flight that are named one by one."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from servofd.detection import judge
from servofd.detection.judge import Naming


class Recorder:
    """A flight whose windows say when they begin and end; the servo moves by so much in each second."""

    def __init__(self, deg_per_s: float) -> None:
        self.deg_per_s = deg_per_s
        self.asked: list[tuple[float, float]] = []

    def window(self, from_s: float, to_s: float, onset: object) -> Any:
        assert onset is None
        self.asked.append((from_s, to_s))
        if to_s <= from_s:
            return None
        return SimpleNamespace(motion_deg=self.deg_per_s * (to_s - from_s), begin_s=from_s, end_s=to_s)


def called(kind: str, **others: float) -> Naming:
    return Naming(None, {kind: 1.0 - sum(others.values()), **others})


@pytest.fixture
def names(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What windows are called: by whoever is put here."""
    naming: dict[str, Any] = {"of": lambda _: called("stuck")}

    def name_fault(window: object) -> Any:
        return naming["of"](window)

    monkeypatch.setattr(judge, "name_fault", name_fault)
    return naming


@pytest.mark.parametrize(
    ("deg_per_s", "asked"),
    [
        (2.0, [(10.0, 13.0)]),
        (1.0, [(10.0, 13.0), (10.0, 16.0)]),
        (0.4, [(10.0, 13.0), (10.0, 16.0), (10.0, 22.0)]),
        (0.3, [(10.0, 13.0), (10.0, 16.0), (10.0, 22.0)]),
    ],
)
@pytest.mark.usefixtures("names")
def test_a_block_grows_until_there_is_motion(deg_per_s: float, asked: list[tuple[float, float]]) -> None:
    flight: Any = Recorder(deg_per_s)
    block = judge._block(flight, 10.0, 0.0, 60.0)
    assert flight.asked == asked
    assert (block is None) == (deg_per_s == 0.3)


@pytest.mark.parametrize(("begin_s", "asked"), [(60.0, (57.0, 60.0)), (5.0, (8.0, 11.0))])
@pytest.mark.usefixtures("names")
def test_a_block_lies_within_the_episode(begin_s: float, asked: tuple[float, float]) -> None:
    flight: Any = Recorder(2.0)
    block = judge._block(flight, begin_s, 8.0, 60.0)
    assert flight.asked == [asked]
    assert block is not None
    assert block.begin_s == asked[0]


@pytest.mark.parametrize("changed_s", [20.0, 33.0, 48.0])
def test_a_fault_that_becomes_another_is_followed_to_when_it_did(names: dict[str, Any], changed_s: float) -> None:
    names["of"] = lambda window: called("bias" if window.begin_s >= changed_s else "slow")
    flight: Any = Recorder(2.0)
    change = judge._change(flight, "slow", 5.0, 60.0)
    assert change is not None
    found_s, then = change
    assert then.kind == "bias"
    assert changed_s <= found_s <= changed_s + 1.5


def test_one_block_alone_is_no_change(names: dict[str, Any]) -> None:
    names["of"] = lambda window: called("bias" if window.begin_s >= 57.0 else "slow")
    flight: Any = Recorder(2.0)
    assert judge._change(flight, "slow", 5.0, 60.0) is None


@pytest.mark.parametrize(
    ("named", "before", "differs"),
    [
        (called("bias"), "slow", True),
        (called("slow"), "slow", False),
        (called("stuck"), "hardover", False),  # only the onset tells which
        (called("bias"), "stuck", True),
        (called("stuck"), "bias", True),
        (called("floating"), "bias", False),
        (called("unknown"), "bias", False),
        (called("bias", slow=0.2), "slow", False),
        (called("bias", slow=0.01), "slow", True),
    ],
)
def test_what_differs_for_sure(named: Naming, before: str, *, differs: bool) -> None:
    assert judge._differs(named, before) == differs


def test_an_onset_is_where_the_surface_was_and_how_far_it_would_have_moved_until_it_was_looked_at() -> None:
    time_s = np.arange(500) / 50.0
    measured_deg = 10.0 * time_s
    measured_deg[:3] = np.nan
    residuals = SimpleNamespace(
        time_s=time_s, settled=time_s >= 1.0, measured_deg=measured_deg, simulated_deg=20.0 * time_s
    )
    flight: Any = SimpleNamespace(residuals=residuals)
    onset = judge._onset(flight, 4.0)
    assert onset is not None
    assert onset.time_s == 4.0
    assert onset.low_deg == pytest.approx(80.0)
    assert onset.position_deg == pytest.approx(10.0 * (4.0 - 0.03))  # median of the last four
    assert onset.high_deg == pytest.approx(20.0 * 4.26)  # the first sample a quarter of a second later
    assert judge._onset(flight, 1.49) is None
    assert judge._onset(flight, 1.51) is not None
