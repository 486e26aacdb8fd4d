"""Verdicts on servos that nobody named: aircraft of `strangers`, whose physics no model of servofd has."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
import pytest
from strangers import Failure, Flight, draw_failure, fly, stranger

import servofd
from servofd.servo.library import servo_named
from servofd.servo.servo_model import ServoModel

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from servofd.core.types import FloatArray
    from servofd.detection.verdict import SurfaceAudit


def verdicts(flight: Flight, path: Path) -> dict[str, SurfaceAudit]:
    (result,) = servofd.audit(flight.write(path))
    return {surface.surface: surface for surface in result.surfaces}


def cut(flight: Flight, until_s: float) -> Flight:
    commands, positions = flight.command_s < until_s, flight.position_s < until_s
    return replace(
        flight,
        command_s=flight.command_s[commands],
        command_deg=flight.command_deg[commands],
        airspeed_m_s=flight.airspeed_m_s[commands],
        supply_v=flight.supply_v[commands],
        position_s=flight.position_s[positions],
        position_deg=flight.position_deg[positions],
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("until_s", "suffix", "seed"),
    [
        (15.0, "csv", 1),
        *(
            pytest.param(*each, marks=pytest.mark.nightly)
            for each in (
                (60.0, "bin", 3),
                (15.0, "csv", 3),
                (60.0, "bin", 1),
                (15.0, "bin", 1),
                (15.0, "bin", 3),
                (60.0, "csv", 1),
            )
        ),
    ],
)
def test_a_sound_aircraft_has_no_fault_however_short_its_log(
    until_s: float, suffix: str, seed: int, tmp_path: Path
) -> None:
    flight = cut(fly(stranger(seed), 1, "aerobatics", duration_s=60.0), until_s)
    assert "fault" not in {s.status for s in verdicts(flight, tmp_path / f"flight.{suffix}").values()}


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", ["stuck", *(pytest.param(each, marks=pytest.mark.nightly) for each in ("hardover", "floating"))]
)
def test_what_no_longer_follows_is_a_fault_and_nothing_else_is(kind: str, tmp_path: Path) -> None:
    failure = Failure(kind, "rudder", 25.0)
    flown = fly(stranger(5), 1, "aerobatics", duration_s=60.0, failure=failure)
    found = verdicts(flown.only("elevator", "rudder"), tmp_path / "flight.csv")
    assert found["rudder"].status == "fault"
    assert found["rudder"].model.origin == "fitted"
    assert 24.0 < found["rudder"].faults[0].start_s < 33.0  # when it was first asked to move
    assert {name for name, surface in found.items() if surface.status == "fault"} == {"rudder"}


@pytest.mark.slow
def test_a_surface_that_does_not_answer_is_at_fault_where_no_other_can_be_judged(tmp_path: Path) -> None:
    failure = draw_failure(18, 120.0, "hardover", "large")
    flown = fly(stranger(18), 1, "loiter", duration_s=120.0, failure=failure)
    found = verdicts(flown.only("elevator", "rudder"), tmp_path / "flight.csv")
    assert found["rudder"].status == "fault"
    assert abs(found["rudder"].faults[0].start_s - failure.start_s) < 1.0
    assert {surface.status for name, surface in found.items() if name != "rudder"} == {"unknown"}


@pytest.mark.slow
def test_what_rests_in_the_middle_of_its_travel_is_held_by_no_stop(tmp_path: Path) -> None:
    flown = fly(stranger(136), 1, "cruise", duration_s=80.0, failure=Failure("stuck", "elevator", 44.0))
    found = verdicts(flown.only("elevator"), tmp_path / "flight.csv")["elevator"]
    assert [abs(fault.start_s - 44.0) < 3.0 for fault in found.faults] == [True]
    assert found.faults[0].kind in ("stuck", "hardover")  # where it stopped, it had hardly been before


@pytest.mark.slow
def test_an_offset_is_found_and_measured(tmp_path: Path) -> None:
    flown = fly(stranger(5), 1, "aerobatics", duration_s=60.0, failure=Failure("bias", "elevator", 40.0, 4.0))
    found = verdicts(flown.only("elevator"), tmp_path / "flight.csv")["elevator"]
    assert [(fault.kind, abs(fault.start_s - 40.0) < 1.0) for fault in found.faults] == [("bias", True)]
    assert found.faults[0].parameters["bias_deg"].value == pytest.approx(4.0, abs=0.5)


@pytest.mark.slow
def test_positions_that_freeze_together_are_one_event_and_no_fault(tmp_path: Path) -> None:
    flown = fly(stranger(5), 1, "aerobatics", duration_s=60.0).only("elevator", "rudder")
    frozen = (flown.position_s > 30.0) & (flown.position_s < 36.0)
    held_deg = np.where(frozen[:, None], flown.position_deg[np.argmax(frozen)], flown.position_deg)
    found = verdicts(replace(flown, position_deg=held_deg), tmp_path / "flight.csv")
    assert {surface.status for surface in found.values()} == {"healthy"}
    assert all("s of frozen telemetry not judged" in surface.reason for surface in found.values())
    told = [float(surface.reason.split(" s of frozen")[0].split()[-1]) for surface in found.values()]
    assert told == pytest.approx([6.0] * 2, abs=0.3)


@pytest.mark.slow
def test_commands_that_stop_leave_nothing_cleared(tmp_path: Path) -> None:
    flown = fly(stranger(4), 1, "mixed", duration_s=60.0).only("elevator", "rudder")
    early = flown.command_s < 25.0
    stopped = replace(
        flown,
        command_s=flown.command_s[early],
        command_deg=flown.command_deg[early],
        airspeed_m_s=flown.airspeed_m_s[early],
        supply_v=flown.supply_v[early],
    )
    assert "healthy" not in {surface.status for surface in verdicts(stopped, tmp_path / "flight.csv").values()}


@pytest.mark.slow
def test_a_healthy_surface_tells_what_would_have_been_seen(tmp_path: Path) -> None:
    found = verdicts(fly(stranger(4), 1, "mixed", duration_s=120.0).only("elevator"), tmp_path / "flight.csv")
    healthy = [surface for surface in found.values() if surface.status == "healthy"]
    assert healthy
    for surface in healthy:
        shown = surface.detectable
        assert shown.loss_share is not None
        assert shown.loss_share <= 0.34
        assert (shown.slow_share is None) == ("speed" in surface.reason and "not judgeable" in surface.reason)


@cache
def three_faults() -> servofd.Audit:
    """The sample that has no aircraft file, as every question here is asked of it."""
    (found,) = servofd.audit("sample_logs/table_three_faults.csv")
    assert isinstance(found, servofd.Audit)
    return found


@cache
def good_aileron() -> tuple[pd.DataFrame, SurfaceAudit]:
    table = pd.read_csv("sample_logs/table_three_faults.csv")[["time_s", "aileron_cmd_deg", "aileron_pos_deg"]]
    return table, servofd.audit(table)[0].surfaces[0]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["loss_share", "oscillation_deg"])
@pytest.mark.parametrize("share", [0.45, pytest.param(0.6, marks=pytest.mark.nightly)])
def test_a_fault_of_the_stated_size_behind_the_fitted_part_shows(kind: str, share: float) -> None:
    table, good = good_aileron()
    assert good.status == "healthy"
    assert good.model.fitted_between_s is not None
    size = good.detectable.document()[kind]
    assert size is not None
    time_s, position_deg = table["time_s"].to_numpy(), table["aileron_pos_deg"].to_numpy()
    wave = size * np.sin(2.0 * np.pi * 3.0 * time_s)
    broken = (1.0 - size) * position_deg if kind == "loss_share" else position_deg + wave
    after = time_s >= time_s[0] + share * np.ptp(time_s)
    bad = table.assign(aileron_pos_deg=np.where(after, broken, position_deg))
    assert servofd.audit(bad)[0].surfaces[0].status in ("suspect", "fault")


@pytest.mark.slow
def test_a_reversed_sign_is_told_and_not_hidden_by_wide_tolerances(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    time_s = np.arange(600) / 10.0
    command_deg = 15.0 * np.sin(1.3 * time_s) + 5.0 * np.sin(3.1 * time_s)
    position_deg = -np.interp(time_s - 0.15, time_s, command_deg) + 0.1 * rng.standard_normal(600)
    path = tmp_path / "reversed.csv"
    table = np.column_stack([time_s, command_deg, position_deg])
    np.savetxt(path, table, delimiter=",", header="time_s,a_cmd_deg,a_pos_deg", comments="")
    (result,) = servofd.audit(path)
    (surface,) = result.surfaces
    assert surface.status == "suspect"
    assert "check the sign" in surface.reason


@pytest.mark.slow
def test_a_file_that_names_no_servo_has_it_fitted(tmp_path: Path) -> None:
    """And of one file, surfaces whose servo is named keep theirs."""
    entry = """[surfaces.{name}]
{servo}
command = {{ channel = "{name}_cmd_deg", unit = "deg" }}
measured = {{ channel = "{name}_pos_deg", unit = "deg" }}
"""
    config = tmp_path / "plane.toml"
    config.write_text(
        entry.format(name="aileron", servo="") + entry.format(name="elevator", servo='servo = "hs225bb-eq31"')
    )
    (result,) = servofd.audit("sample_logs/table_three_faults.csv", config)
    assert [(verdict.servo, verdict.model.origin) for verdict in result.surfaces] == [
        ("aileron-fitted", "fitted"),
        ("hs225bb-eq31", "named"),
    ]


@pytest.mark.slow
def test_what_began_late_is_told_the_right_way_round() -> None:
    """The rudder is off for thirty of forty seconds: most of the log is faulty, and the servo is that of the rest."""
    result = three_faults()
    (fault,) = result["rudder"].faults
    assert (fault.kind, fault.end_s) == ("bias", None)
    assert fault.start_s == pytest.approx(10.0, abs=0.5)
    assert fault.parameters["bias_deg"].value == pytest.approx(2.5, abs=0.1)
    first, second = result["elevator"].faults
    assert (first.kind, second.kind) == ("deadband", "stuck")
    assert [first.start_s, first.end_s, second.start_s] == pytest.approx([5.0, 14.0, 30.0], abs=0.3)
    assert result["aileron"].status == "healthy"


@pytest.mark.slow
@pytest.mark.parametrize("resting", [1, 3])
def test_what_was_not_tried_does_not_keep_the_others_from_being_cleared(resting: int, tmp_path: Path) -> None:
    """Unless it is most of the aircraft."""
    table = pd.read_csv("sample_logs/table_three_faults.csv")[["time_s", "aileron_cmd_deg", "aileron_pos_deg"]]
    table = table.assign(rudder_cmd_deg=table["aileron_cmd_deg"], rudder_pos_deg=table["aileron_pos_deg"])
    noise_deg = np.random.default_rng(1).normal(0.0, 0.05, (len(table), resting))
    for k in range(resting):
        table[f"flap{k}_cmd_deg"], table[f"flap{k}_pos_deg"] = 0.0, noise_deg[:, k].round(3)
    table.to_csv(tmp_path / "flight.csv", index=False)
    (result,) = servofd.audit(tmp_path / "flight.csv")
    assert bool(result.not_judged) == (resting == 3)
    if resting == 1:
        assert result.sentence == "All 2 surfaces that could be judged followed their commands. Flap0 was not tried."


def bench(rate_hz: float, about_deg: float, fault: str = "") -> dict[str, FloatArray]:
    """A servo without a name that is sent about some angle in steps, and jams or slips after 25 s."""
    rng, model = np.random.default_rng(3), ServoModel.of(servo_named("hs225bb-eq31"))
    time_s = np.arange(0.0, 35.0, 1.0 / rate_hz)
    asked_deg = 9.0 * np.array([0.0, 1.0, -1.0, 0.5, 1.0, -0.5])[(time_s // 1.3).astype(int) % 6]
    moved_deg = 0.96 * model.simulate(time_s, asked_deg, time_s)
    late = time_s > 25.0
    if fault == "jam":
        moved_deg[late] = moved_deg[late][0]
    elif fault == "offset":
        moved_deg[late] += 3.0
    moved_deg += 0.1 * rng.standard_normal(time_s.size)
    return {"time_s": time_s, "arm_cmd_deg": about_deg + asked_deg, "arm_pos_deg": about_deg + moved_deg}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rate_hz", "about_deg", "fault", "status"),
    [
        (1000.0, 0.0, "", "healthy"),
        (50.0, 180.0, "jam", "fault"),
        *(
            pytest.param(*where, *what, marks=pytest.mark.nightly)
            for where in ((1000.0, 0.0), (50.0, 180.0))
            for what in (("", "healthy"), ("jam", "fault"), ("offset", "fault"))
            if (where[0], what[0]) not in ((1000.0, ""), (50.0, "jam"))
        ),
    ],
)
def test_a_bench_at_1_khz_and_a_servo_far_from_zero_are_judged_as_any_other(
    rate_hz: float, about_deg: float, fault: str, status: str
) -> None:
    (audit,) = servofd.audit(bench(rate_hz, about_deg, fault))
    verdict = audit.surfaces[0]
    assert verdict.status == status, verdict.reason
    assert not verdict.faults or abs(verdict.faults[0].start_s - 25.0) < 1.5


@pytest.mark.slow
def test_a_servo_far_from_zero_is_known_as_well_as_one_about_it() -> None:
    near, far = (servofd.audit(bench(50.0, about_deg))[0].surfaces[0] for about_deg in (0.0, 180.0))
    assert far.threshold_deg == pytest.approx(near.threshold_deg, rel=0.4)
    assert far.detectable.bias_deg == pytest.approx(near.detectable.bias_deg, rel=0.4)


@pytest.mark.slow
def test_a_surface_that_leaves_its_command_is_not_cleared_however_little_was_asked(tmp_path: Path) -> None:
    rng, t = np.random.default_rng(3), np.arange(0.0, 120.0, 0.1)
    asked_deg = 0.3 * np.sin(t) + np.where((t > 60.2) & (t < 64.0), -3.5 * np.sin(1.6 * (t - 60.2)), 0.0)
    ran_deg = np.interp(t, [60.0, 60.4], [0.2, -23.7]) + 0.06 * rng.standard_normal(t.size)
    table = pd.DataFrame({"time_s": t, "rudder_cmd_deg": asked_deg, "rudder_pos_deg": np.round(ran_deg, 1)})
    table.to_csv(tmp_path / "calm.csv", index=False)
    (result,) = servofd.audit(tmp_path / "calm.csv")
    rudder = result["rudder"]
    assert rudder.status in {"fault", "suspect"}
    assert "23 deg from all that it is asked for since 60 s" in rudder.reason
    full = table.assign(rudder_cmd_deg=np.where((t > 80.0) & (t < 82.0), -25.0, asked_deg))  # the way it went
    (result,) = servofd.audit(full)
    assert result["rudder"].status in {"fault", "suspect"}
    table[table.time_s > 61.0].to_csv(tmp_path / "since.csv", index=False)  # it may have been trimmed so
    (result,) = servofd.audit(tmp_path / "since.csv")
    assert result["rudder"].status != "healthy"


@pytest.mark.slow
def test_the_servo_of_a_surface_that_nobody_asked_about_is_not_fitted() -> None:
    alone, whole = servofd.audit("sample_logs/table_three_faults.csv", surfaces=("rudder",))[0], three_faults()
    fitted = [name for name, surface in alone.aircraft.surfaces.items() if surface.model.origin == "fitted"]
    assert fitted == [surface.surface for surface in alone.surfaces] == ["rudder"]
    assert [(f.kind, f.start_s) for f in alone["rudder"].faults] == [
        (f.kind, f.start_s) for f in whole["rudder"].faults
    ]


@pytest.mark.parametrize(
    ("rows", "position_deg"),
    [
        (45, lambda at_s: 5.0 * np.sin(at_s)),
        (6000, lambda at_s: np.where(at_s < 20.0, 0.0, 2050.0)),
        (6000, lambda at_s: np.where((at_s > 60.0) & (at_s < 65.0), -9999.0, 0.0)),
    ],
    ids=["less than a second", "counts, once its sensor has begun", "a value that stands for none"],
)
def test_no_surface_leaves_its_command_by_what_is_no_angle(
    rows: int, position_deg: Callable[[FloatArray], FloatArray]
) -> None:
    t = np.arange(rows) / 50.0
    noise_deg = 0.05 * np.random.default_rng(4).standard_normal(rows)
    asked_deg = 0.2 * np.sin(t) if rows > 50 else 5.0 * np.sin(t)
    (result,) = servofd.audit(
        pd.DataFrame({"time_s": t, "rudder_cmd_deg": asked_deg, "rudder_pos_deg": position_deg(t) + noise_deg})
    )
    assert result["rudder"].status == "unknown"


def test_a_surface_that_comes_back_to_its_command_was_away_for_so_long() -> None:
    t = np.arange(0.0, 120.0, 0.05)
    gone = (t > 60.0) & (t < 70.0)
    noise_deg = 0.05 * np.random.default_rng(4).standard_normal(t.size)
    position_deg = np.where(gone, 20.0, 0.2 * np.sin(t)) + noise_deg
    whole = {"time_s": t, "rudder_cmd_deg": 0.2 * np.sin(t), "rudder_pos_deg": position_deg}
    for at_s in (t, np.where(t < 80.0, t, t + 1e7)):  # the clock of an autopilot may be set in flight
        (result,) = servofd.audit(pd.DataFrame({**whole, "time_s": at_s}))
        assert result["rudder"].status == "suspect"
        assert "20 deg from all that it is asked for from 60 to 70 s" in result["rudder"].reason


@pytest.mark.slow
def test_volts_on_which_no_servo_moves_are_no_reading_where_it_follows() -> None:
    table, good = good_aileron()
    assert good.status == "healthy"
    gone = (table.time_s > table.time_s[0] + 17.0) & (table.time_s < table.time_s[0] + 20.0)
    (found,) = servofd.audit(table.assign(servo_voltage_v=np.where(gone, 0.0, 6.0)))
    assert (found.surfaces[0].status, found.common_causes) == ("healthy", ())


@pytest.mark.slow
def test_a_surface_that_swings_against_its_autopilot_is_no_servo_that_rings(tmp_path: Path) -> None:
    """From 64 s on it swings as a servo of 2.6 Hz and a damping of 0.2 would for what the autopilot does about it."""
    rng, time_s, swings_s = np.random.default_rng(0), np.arange(0.0, 110.0, 0.02), 64.0
    window = np.hanning(101)
    command_deg = np.convolve(rng.normal(size=time_s.size), window, "same")
    command_deg *= 0.35 / command_deg.std()
    command_deg += np.where(time_s >= swings_s, 0.6 * np.cos(2.0 * np.pi * 2.6 * time_s), 0.0)
    position_deg, at_deg, speed_deg_s = np.zeros(time_s.size), 0.0, 0.0
    for k, now_s in enumerate(time_s.tolist()):
        rad_s, damping = (40.0, 0.8) if now_s < swings_s else (2.0 * np.pi * 2.6, 0.2)
        away_deg = command_deg[max(k - 2, 0)] - at_deg
        speed_deg_s += 0.02 * (rad_s**2 * away_deg - 2.0 * damping * rad_s * speed_deg_s)
        at_deg += 0.02 * speed_deg_s
        position_deg[k] = at_deg
    read_deg = np.round(10.0 * (position_deg + rng.normal(0.0, 0.04, time_s.size))) / 10.0
    table = pd.DataFrame({"time_s": time_s, "rudder_cmd_deg": command_deg, "rudder_pos_deg": read_deg})
    path = tmp_path / "flight.csv"
    table.to_csv(path, index=False)
    (audit,) = servofd.audit(path)
    assert [fault.kind for fault in audit["rudder"].faults] == ["oscillation"]
    assert audit["rudder"].faults[0].start_s == pytest.approx(swings_s, abs=1.0)
