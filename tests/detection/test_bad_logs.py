"""Logs to judge nobody by, without an aircraft file: no fault where none is, and healthy only what was seen."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import pytest
from strangers import SURFACES, draw_failure, fly, stranger

import servofd

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from strangers import Flight

    from servofd.core.types import FloatArray
    from servofd.detection.verdict import SurfaceAudit

SEED = 220
TWO = SURFACES[1:3]
"""That is enough of an aircraft; each surface has a servo to be fitted."""


def table(seed: int, style: str, time_s: FloatArray | None = None) -> pd.DataFrame:
    """A healthy flight as a recorder would write it: in each row the last command, if it is fresh, and position."""
    flown = fly(stranger(seed), 1, style, duration_s=90.0).only(*TWO)
    time_s = flown.position_s[flown.position_s > 1.0] if time_s is None else time_s
    asked, seen = (
        np.maximum(np.searchsorted(at_s, time_s, side="right") - 1, 0) for at_s in (flown.command_s, flown.position_s)
    )
    columns = {"time_s": time_s}
    fresh = time_s - flown.command_s[asked] < 0.06
    for place, name in enumerate(flown.surfaces):
        columns[f"{name}_cmd_deg"] = np.where(fresh, flown.command_deg[asked, place], np.nan)
        columns[f"{name}_pos_deg"] = flown.position_deg[seen, place]
    return pd.DataFrame(columns)


def changed(
    frame: pd.DataFrame, change: Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
) -> pd.DataFrame:
    """The same with other commands and positions of all surfaces."""
    columns = {"time_s": frame["time_s"].to_numpy()}
    for name in TWO:
        names = f"{name}_cmd_deg", f"{name}_pos_deg"
        columns |= dict(zip(names, change(*(frame[each].to_numpy() for each in names)), strict=True))
    return pd.DataFrame(columns)


def judged(frame: pd.DataFrame) -> dict[str, SurfaceAudit]:
    return {each.surface: each for each in servofd.audit(frame)[0].surfaces}


def noise_deg(like: FloatArray) -> FloatArray:
    return np.random.default_rng(3).normal(0.0, 0.05, like.shape)


@pytest.mark.slow
def test_a_log_without_motion_tells_nothing_and_says_so() -> None:
    frame = changed(table(SEED, "cruise"), lambda asked, seen: (0.0 * asked + 1.0, 1.0 + noise_deg(seen)))
    for verdict in judged(frame).values():
        assert verdict.status == "unknown"
        assert "command stays within 0 deg" in verdict.reason


@pytest.mark.slow
def test_one_surface_alone_is_judged_as_among_others() -> None:
    frame = table(SEED, "aerobatics")
    alone = judged(frame[["time_s", "elevator_cmd_deg", "elevator_pos_deg"]])
    among = judged(frame)["elevator"]
    assert list(alone) == ["elevator"]
    assert (alone["elevator"].status, alone["elevator"].reason) == (among.status, among.reason)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "told"),
    [
        pytest.param(
            lambda asked, seen: (asked, 3.0 + noise_deg(seen)),
            "jammed from the beginning, or no reading",
            marks=pytest.mark.nightly,
        ),
        pytest.param(
            lambda asked, seen: (asked, 20.0 * np.sin(0.01 * np.arange(seen.size))),
            "no servo predicts this surface",
            marks=pytest.mark.nightly,
        ),
        pytest.param(lambda asked, seen: (asked, -seen), "check the sign", marks=pytest.mark.nightly),
        (lambda asked, seen: (asked, np.deg2rad(seen)), "x the command throughout: check the scale"),
        pytest.param(lambda asked, seen: (asked, 0.4 * seen), "times its command", marks=pytest.mark.nightly),
    ],
    ids=["jammed", "floating", "reversed", "radians", "weak"],
)
def test_what_was_so_from_the_beginning_is_told_and_no_fault_of_all_servos(
    change: Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]], told: str
) -> None:
    for verdict in judged(changed(table(SEED, "aerobatics"), change)).values():
        assert told in verdict.reason
        assert verdict.status in {"unknown", "suspect"} or "from the beginning on" in verdict.reason


FORMS = ("bin", *(pytest.param(form, marks=pytest.mark.nightly) for form in ("csv", "tlog")))
"""Tables go the way of the DataFrames above."""


@cache
def _minute(rate_hz: float | None) -> Flight:
    return fly(stranger(SEED, position_hz=rate_hz), 1, "aerobatics", duration_s=60.0).only(*TWO)


def in_form(form: str, folder: Path, change: Callable[[Flight], Flight], rate_hz: float | None = None) -> list[Any]:
    """Verdicts on a healthy minute, changed, in a form of its own, without any aircraft file."""
    return list(servofd.audit(change(_minute(rate_hz)).write(folder / f"flight.{form}"))[0].surfaces)


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda f: replace(f, command_deg=0.0 * f.command_deg + 1.0), "command stays within 0 deg"),
        (lambda f: replace(f, position_deg=3.0 + noise_deg(f.position_deg)), "jammed from the beginning, or no read"),
        (lambda f: replace(f, position_deg=_wanders(f)), "no servo predicts this surface"),
    ],
    ids=["no motion", "jammed", "floating"],
)
def test_an_autopilots_log_or_table_that_tells_nothing_says_why(
    form: str, change: Callable[[Flight], Flight], told: str, tmp_path: Path
) -> None:
    (verdict,) = in_form(form, tmp_path, lambda flight: change(flight.only(TWO[0])))
    assert verdict.status == "unknown"
    assert told in verdict.reason


def _wanders(flight: Flight) -> FloatArray:
    wandering_deg: FloatArray = 20.0 * np.sin(0.01 * np.arange(flight.position_s.size, dtype=np.float64))[:, None]
    return wandering_deg


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    ("change", "rate_hz"),
    [
        (lambda f: replace(f, command_deg=np.abs(f.command_deg), position_deg=np.abs(f.position_deg)), None),
        (lambda f: f, 9.99),
    ],
    ids=["one direction only", "9.99 Hz"],
)
def test_an_autopilots_log_or_table_is_judged_and_accuses_nobody(
    form: str, change: Callable[[Flight], Flight], rate_hz: float | None, tmp_path: Path
) -> None:
    found = in_form(form, tmp_path, change, rate_hz)
    assert {verdict.status for verdict in found} <= {"healthy", "suspect", "unknown"}
    assert [verdict.model.origin for verdict in found] == ["fitted"] * len(TWO)


@pytest.mark.slow
def test_a_sign_is_a_convention_of_an_autopilot(tmp_path: Path) -> None:
    """Pulses have no angle of their own: a servo that turns the other way is mounted so. In a table it is an error."""
    found = in_form("bin", tmp_path, lambda f: replace(f, position_deg=-f.position_deg))
    assert all(verdict.status != "fault" for verdict in found)
    assert not any("check the sign" in verdict.reason for verdict in found)


@pytest.mark.parametrize("form", FORMS)
def test_three_rows_of_any_form_are_no_flight(form: str, tmp_path: Path) -> None:
    found = in_form(form, tmp_path, lambda f: f.until(0.12))
    assert {verdict.status for verdict in found} <= {"unknown", "no_data"}


@pytest.mark.nightly
@pytest.mark.parametrize(("rate_hz", "seeds"), [(each, (200, 206, 218, 220)) for each in (9.99, 10.0)])
def test_rows_of_ten_hertz_that_come_unevenly_are_judged_and_their_servos_not_accused(
    rate_hz: float, seeds: tuple[int, ...]
) -> None:
    """Four of five commands are between the rows: a jerk that came and went looked like an oscillation."""
    origins = []
    for seed in seeds:
        shaken_s = np.random.default_rng(seed).uniform(-0.03, 0.03, int(88 * rate_hz))
        time_s = np.sort(1.0 + np.arange(shaken_s.size) / rate_hz + shaken_s)
        for style in ("aerobatics", "turbulence"):
            found = judged(table(seed, style, time_s)).values()
            assert all(verdict.status != "fault" for verdict in found)
            origins += [verdict.model.origin for verdict in found]
    assert origins.count("fitted") >= 1.5 * len(seeds)


@pytest.mark.slow
def test_a_jam_in_little_motion_shows_at_10_hz(tmp_path: Path) -> None:
    """A residual counts for three sigma there, so that no mean square may be asked for more than nine."""
    failure = draw_failure(9836, 110.0, "stuck", "large")
    flight = fly(stranger(9836, position_hz=10.0), 1, "loiter", duration_s=110.0, failure=failure)
    (log,) = servofd.audit(flight.only(failure.surface).write(tmp_path / "flight.csv"))
    assert [fault.kind for fault in log[failure.surface].faults] == ["stuck"]
    assert abs(log[failure.surface].faults[0].start_s - failure.start_s) < 1.0


@pytest.mark.slow
def test_a_reading_that_a_slow_logger_holds_for_three_rows_accuses_nobody(tmp_path: Path) -> None:
    flight = fly(stranger(15), 2, "turbulence", duration_s=60.0).only("elevator")
    assert np.median(np.diff(flight.position_s)) == pytest.approx(0.1, abs=0.01)
    deg, turns = flight.position_deg.copy(), int(np.searchsorted(flight.position_s, 20.3))  # where it turns round
    deg[turns + 1 : turns + 4] = deg[turns]
    (log,) = servofd.audit(replace(flight, position_deg=deg).write(tmp_path / "flight.csv"))
    assert log["elevator"].status != "fault"
