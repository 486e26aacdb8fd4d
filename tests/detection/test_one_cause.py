"""What befalls all servos at one instant is one cause; what befalls one while others are silent is its own."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from strangers import ALL, Failure, fly, stranger

import servofd
from logparsers.codec import Codec
from servofd.aircraft.schema import Aircraft, plain_aircraft
from servofd.core.types import BoolArray, FloatArray
from servofd.detection.causes import before_it_fell, cause_of_alarms, with_common_causes
from servofd.detection.event import Event
from servofd.detection.verdict import CurrentAudit, Fault, SurfaceAudit
from servofd.feedback.flown import one_log
from servofd.live.run import Pace, replay_log
from servofd.live.session import Session
from servofd.live.vehicle import Vehicle
from servofd.servo.context import Context
from servofd.servo.effects.commands import Delay
from servofd.servo.effects.linkage import RateLimit
from servofd.servo.library import second_order
from servofd.servo.loops import lagged_twice
from servofd.servo.servo_model import ServoModel
from servofd.simulation.commands import doublets

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


@pytest.mark.slow
def test_servos_that_lose_speed_in_one_instant_tell_it_together(tmp_path: Path) -> None:
    """Alone some take what they do afterwards for all that they could ever do."""
    failure = Failure("slow", ALL, start_s=39.0, size=1.0 / 3.0)
    log = fly(stranger(22012), 1, "turbulence", duration_s=110.0, failure=failure).write(tmp_path / "flight.csv")
    (found,) = servofd.audit(log)
    assert [cause.kind for cause in found.common_causes] == ["supply"]
    for surface in found.surfaces:
        (fault,) = surface.faults
        assert fault.kind == "slow"
        assert fault.start_s == pytest.approx(39.0, abs=1.0)
        assert fault.end_s is None


@pytest.mark.slow
@pytest.mark.parametrize(("count", "since_s", "size_deg", "seed"), [(4, 55.0, 16.0, 4), (2, 60.0, 14.0, 1)])
def test_sound_servos_that_all_turn_brisk_at_once_are_not_slow(
    count: int, since_s: float, size_deg: float, seed: int
) -> None:
    """Calm parts never met the largest speed; of several servos together, and of one alone, it is no loss."""
    rng, time_s = np.random.default_rng(seed), np.arange(0.0, 90.0, 0.02)
    columns: dict[str, FloatArray] = {"time_s": time_s}
    for name in ("aileron_left", "aileron_right", "elevator", "rudder")[:count]:
        smooth = lagged_twice(rng.standard_normal(time_s.size), 1.0 - 8.0 * 0.02)
        command_deg = smooth / smooth.std() * np.where(time_s < since_s, 1.5, size_deg)
        fine_s = np.arange(0.0, 90.0, 0.005)
        asked_deg = np.interp(fine_s - 0.03, time_s, command_deg)
        position_deg, at_deg = np.zeros(fine_s.size), 0.0
        for k, want_deg in enumerate(asked_deg.tolist()):
            at_deg += 0.005 * min(max(22.0 * (want_deg - at_deg), -70.0), 70.0)
            position_deg[k] = at_deg
        columns[f"{name}_cmd_deg"] = command_deg
        columns[f"{name}_pos_deg"] = position_deg[::4] + 0.08 * rng.standard_normal(time_s.size)
    (found,) = servofd.audit(pd.DataFrame(columns))
    assert not found.common_causes
    assert [surface.faults for surface in found.surfaces] == [()] * count


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
        assert "3.1 s of frozen telemetry not judged" in verdicts["aileron"].reason  # and what catches up after it
        return
    assert verdicts["aileron"].status == "suspect"
    assert "3 surfaces left their models together" in verdicts["aileron"].reason
    assert "their positions stand still" in verdicts["aileron"].reason


@pytest.mark.slow
@pytest.mark.parametrize("silent_s", [(0.0, 10.0), (15.0, 40.0), (np.inf, np.inf)])
def test_a_jam_is_its_own_whatever_the_others_do(silent_s: tuple[float, float]) -> None:
    others = dict.fromkeys(NAMES[1:], (silent_s[0] <= TIME_S) & (silent_s[1] > TIME_S))
    (fault,) = audited({"aileron": TIME_S >= 20.0}, others)["aileron"].faults
    assert fault.kind == "stuck"
    assert fault.start_s == pytest.approx(20.0, abs=0.6)


@pytest.mark.slow
@pytest.mark.parametrize(("share", "count"), [pytest.param(0.33, 6, marks=pytest.mark.nightly), (0.5, 3)])
def test_servos_that_become_slow_at_once_are_at_fault_of_one_supply(share: float, count: int) -> None:
    """Servos of which nobody knows anything but what this log shows."""
    (result,) = servofd.audit(slowed(count, share))
    assert {surface.status for surface in result.surfaces} == {"fault"}
    for surface in result.surfaces:
        (fault,) = surface.faults
        assert fault.kind == "slow"
        assert fault.parameters["bandwidth_scale"].value == pytest.approx(share, abs=0.1)
    (cause,) = result.common_causes
    assert (cause.kind, cause.end_s, len(cause.surfaces)) == ("supply", None, count)
    assert cause.since_s == pytest.approx(45.0, abs=1.0)
    assert result.sentence.startswith("SUPPLY GAVE WAY at 0:45")


@pytest.mark.slow
@pytest.mark.parametrize("sags", [pytest.param(False, marks=pytest.mark.nightly), True])
def test_two_that_become_slow_with_their_supply_are_at_fault_of_it(sags: bool) -> None:
    """A model that knows the supply explains why they are slow, and does not make them well."""
    table = slowed(2, 0.5)
    time_s = table["time_s"].to_numpy()
    volts_v = np.where(time_s < 45.0, 6.0, 4.3 if sags else 6.0)
    table["servo_voltage_v"] = volts_v + np.random.default_rng(1).normal(0.0, 0.05, time_s.size)
    (result,) = servofd.audit(table)
    assert [fault.kind for surface in result.surfaces for fault in surface.faults] == ["slow", "slow"]
    if not sags:
        assert result.common_causes == ()  # two of two may be chance
        return
    (cause,) = result.common_causes
    assert (cause.kind, cause.surfaces) == ("supply", ("servo0", "servo1"))
    assert result.sentence.startswith("SUPPLY GAVE WAY at 0:45: 2 servos have")
    assert "it fell from 6.0 to 4.2 V" in cause.text


@pytest.mark.slow
@pytest.mark.parametrize("least_v", [4.3, pytest.param(5.6, marks=pytest.mark.nightly)])
def test_a_monitor_names_the_supply_that_gave_way(tmp_path: Path, least_v: float) -> None:
    """What its model knows of the supply makes no slow servo well; and while volts stay, two slow ones are two."""
    table = slowed(2, 0.4)
    time_s = table["time_s"].to_numpy()
    volts_v = np.where(time_s < 45.0, 6.0, least_v)
    table["servo_voltage_v"] = volts_v + np.random.default_rng(1).normal(0.0, 0.05, time_s.size)
    table.to_csv(path := tmp_path / "flight.csv", index=False)
    table[time_s < 42.0].to_csv(good := tmp_path / "good.csv", index=False)
    events, vehicle = replayed(path, servofd.calibrate(good, force=True).aircraft)
    assert not any(each.event == "clear" for each in events)
    assert {alarm.surface: alarm.kind for alarm in vehicle.alarms.all} == {"servo0": "slow", "servo1": "slow"}
    causes = [(cause.kind, cause.surfaces) for cause in vehicle.causes]
    assert causes == ([("supply", ("servo0", "servo1"))] if least_v < 5.0 else [])
    assert all(re.search(r"it fell from (5\.9|6\.[01]) to 4\.\d V", cause.text) for cause in vehicle.causes)


def replayed(path: Path, aircraft: Aircraft) -> tuple[list[Event], Vehicle]:
    """What a monitor publishes of a table, and the vehicle it was watching."""
    session, seen = Session(Codec(0, 191), {0: aircraft}, is_stream=False), Seen()
    now_s = replay_log(session, one_log(path), seen, Pace(0.0), float("inf"))
    seen.events(session.finish(now_s))
    return seen.all, session.vehicles[0]


class Seen:
    """Keeps what a monitor publishes."""

    def __init__(self) -> None:
        self.all: list[Event] = []

    def events(self, events: list[Event]) -> None:
        self.all += events

    def tick(self, now_s: float) -> None:
        pass


@pytest.mark.parametrize(("start_s", "watched", "kind"), [(0.4, 2, "servo_type"), (60.0, 2, ""), (0.4, 6, "")])
def test_alarms_from_the_first_seconds_on_may_be_another_aircrafts_file(
    start_s: float, watched: int, kind: str
) -> None:
    faults = {name: Fault("bias", start_s, start_s + 0.2, None, {}, 0.99, ()) for name in ("left", "right")}
    cause = cause_of_alarms(faults, watched, 0.0, (np.nan, ""))
    assert (cause.kind if cause else "") == kind
    assert cause is None or "another aircraft's file" in cause.text


@pytest.mark.slow
def test_an_offset_that_looked_like_a_jam_at_rest_has_its_name_as_it_moves(tmp_path: Path) -> None:
    """Nothing tells them apart before the surface is asked to move; then a monitor corrects itself."""
    time_s = np.arange(0.0, 90.0, 0.02)
    rng = np.random.default_rng(3)
    command_deg = 8.0 * np.sin(1.3 * time_s) + 6.0 * np.sign(np.sin(0.7 * time_s))
    moved_deg = servo(1.0).simulate(time_s, command_deg, time_s) + rng.normal(0.0, 0.08, time_s.size)
    columns = {"time_s": time_s, "rudder_cmd_deg": command_deg, "rudder_pos_deg": moved_deg}
    pd.DataFrame(columns).to_csv(good := tmp_path / "good.csv", index=False)
    asked_deg = np.where(time_s < 15.0, 0.0, command_deg)
    off_deg = servo(1.0).simulate(time_s, asked_deg, time_s) + 10.0 + rng.normal(0.0, 0.08, time_s.size)
    columns |= {"rudder_cmd_deg": asked_deg, "rudder_pos_deg": off_deg}
    pd.DataFrame(columns).to_csv(path := tmp_path / "flight.csv", index=False)
    events, vehicle = replayed(path, servofd.calibrate(good, force=True).aircraft)
    (alarm,) = vehicle.alarms.all
    assert (alarm.kind, alarm.end_s) == ("bias", None)
    assert events[-1].kind == "bias"
    assert events[-1].time_s < 32.0
    assert alarm.fault is not None
    assert alarm.fault.parameters["bias_deg"].value == pytest.approx(10.0, abs=0.5)


@pytest.mark.nightly
@pytest.mark.parametrize("column", ["servo_voltage_v", "servo1_voltage_v"])
def test_a_supply_that_dies_little_by_little_makes_no_servo_well(column: str) -> None:
    """Down to 2.4 of 6 V within a minute, which is no battery that empties."""
    time_s = np.arange(0.0, 150.0, 0.02)
    shares = np.clip(1.0 - 0.6 * (time_s - 45.0) / 60.0, 0.4, 1.0)
    table = slowed(2, shares)
    table[column] = 6.0 * shares + np.random.default_rng(1).normal(0.0, 0.05, time_s.size)
    (result,) = servofd.audit(table)
    assert {surface.status for surface in result.surfaces} == {"fault"}
    assert {fault.kind for surface in result.surfaces for fault in surface.faults} == {"slow"}
    assert any("it fell from" in cause.text for cause in result.common_causes)


def test_a_clock_that_was_set_in_flight_does_not_keep_a_falling_supply_waiting() -> None:
    time_s = np.append(0.0, 1.7e9 + np.arange(0.0, 60.0))
    volts_v = np.where(time_s < 1.7e9 + 30.0, 6.0, 4.0)
    held = before_it_fell(Context(voltage_s=time_s, voltage_v=volts_v))
    assert held.voltage_v.min() == 6.0


@pytest.mark.parametrize("fell_v", [0.0, 1.6])
def test_volts_that_fall_while_amperes_rise_are_one_supply(fell_v: float) -> None:
    time_s = np.arange(0.0, 120.0, 0.1)
    drawn_a = np.where(time_s < 60.0, 0.2, 0.5)
    surfaces = []
    for k, name in enumerate(("elevon_left", "elevon_right")):
        fault = Fault("binding", 60.0 + 3.0 * k, 82.0, None, {}, 0.9, (), level="suspect", witness="current")
        current = CurrentAudit("suspect", "", suspicions=(fault,), time_s=time_s, current_a=drawn_a)
        given = SurfaceAudit(name, "suspect", "", "unknown", "constant", 1.5, True, suspicions=(fault,))
        surfaces.append(replace(given, current=current))
    found, causes = with_common_causes(surfaces, [(time_s, np.where(time_s < 60.0, 6.0, 6.0 - fell_v))])
    assert {surface.status for surface in found} == {"fault" if fell_v else "suspect"}
    assert [cause.kind for cause in causes] == (["supply"] if fell_v else [])
    assert all("fell from 6.0 to 4.4 V while its servos drew 1 A instead of 0.4" in cause.text for cause in causes)


def slowed(count: int, share: float | FloatArray) -> pd.DataFrame:
    """Servos that have a share of their speed from 45 s on, or at each instant."""
    shares = np.where(np.arange(0.0, 90.0, 0.02) < 45.0, 1.0, share) if np.ndim(share) == 0 else np.asarray(share)
    time_s: FloatArray = np.arange(0.0, shares.size) * 0.02
    parts = np.linspace(shares.min(), shares.max(), 7)
    columns: dict[str, FloatArray] = {}
    for k in range(count):
        rng = np.random.default_rng(k)
        command_deg = doublets(time_s, rng) + 6.0 * np.sin((1.0 + 0.3 * k) * time_s)
        moved_deg = np.array([servo(part).simulate(time_s, command_deg, time_s) for part in parts])
        nearest = np.abs(shares[:, None] - parts).argmin(axis=1)
        measured_deg = moved_deg[nearest, np.arange(time_s.size)] + rng.normal(0.0, 0.08, time_s.size)
        columns |= {f"servo{k}_cmd_deg": command_deg, f"servo{k}_pos_deg": measured_deg}
    return pd.DataFrame({"time_s": time_s, **columns})


def servo(share: float) -> ServoModel:
    """One with such a share of its speed."""
    return ServoModel(second_order(2.0 * np.pi * 6.0 * share, 0.8)) + Delay(0.02) + RateLimit(300.0 * share)
