"""What is no measurement is marked once, with its reason, in every format, and every verb and the monitor see it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import servofd
from logparsers import Channel
from logparsers.records import Damage
from servofd.aircraft.marks import LAST_WITH_VALUE, Rows, Why, marked
from servofd.aircraft.schema import Aircraft, load_aircraft, plain_aircraft
from servofd.aircraft.series import Series, bus_of, cut
from servofd.aircraft.watch import Bus, New, Watch
from servofd.batch.key import Job
from servofd.core.errors import NoMeasurement
from servofd.core.types import BoolArray, FloatArray
from servofd.feedback.flown import one_log, surfaces_of
from servofd.jobs.bench import bench_tests
from servofd.jobs.workflow import audit, flights_of
from servofd.servo.library import servo_named
from servofd.servo.servo_model import ServoModel
from servofd.simulation.flight import SimulatedFlight, simulate_flight
from servofd.simulation.pulses import outputs_of
from servofd.simulation.writers import write_flight

FORMATS = (".csv", ".mat", ".bin", ".tlog", ".ulg")
REASONS = ("FROZEN", "HELD", "DUPLICATE", "ECHO", "SPIKE", "GAP", "UNSETTLED")
SPOILT_S = {"FROZEN": 0.6, "HELD": 0.18, "DUPLICATE": 0.06, "ECHO": 1.0, "GAP": 3.0, "UNSETTLED": 1.0}
"""For how long each reason lasts."""
HZ = 50.0


def aircraft_for(suffix: str) -> Aircraft:
    """A .mat is of an aircraft without an autopilot."""
    return load_aircraft("faser" if suffix == ".mat" else "simulated")


def flown(suffix: str = ".csv") -> SimulatedFlight:
    aircraft = aircraft_for(suffix)
    outputs = () if suffix == ".mat" else outputs_of(aircraft)
    return simulate_flight(aircraft, duration_s=30.0, rate_hz=HZ, seed=5, noise_deg=0.02, outputs=outputs)


def spoilt(flight: SimulatedFlight, reason: str) -> tuple[SimulatedFlight, BoolArray]:
    """The flight with one reason in it, and the rows of the second surface that are concerned."""
    deg, rows = flight.measured_deg.copy(), np.zeros(flight.time_s.size, dtype=bool)
    fastest = 300 + int(np.argmax(np.abs(np.diff(deg[300:1200, 1]))))
    if reason == "SPIKE":
        rows[[fastest, 1300]] = True
        deg[rows, 1] += 25.0
        return replace(flight, measured_deg=deg), rows
    first, last = fastest, fastest + round(SPOILT_S[reason] * HZ)
    rows[first:last] = True
    if reason == "UNSETTLED":  # nothing is known of what came before
        names = ("time_s", "command_deg", "measured_deg", "received_deg", "pulse_us")
        kept = {name: getattr(flight, name)[first:] for name in names}
        return replace(flight, **kept), rows[first:]
    if reason == "GAP":  # a pulse of 0 us is no command
        asked_deg, pulse_us = flight.command_deg.copy(), flight.pulse_us.copy()
        asked_deg[rows], pulse_us[rows[: len(pulse_us)]] = np.nan, 0
        rows[: first + round(HZ)] = False
        return replace(flight, command_deg=asked_deg, pulse_us=pulse_us), rows
    if reason == "ECHO":
        deg[rows, 1] = flight.command_deg[rows, 1]
    elif reason == "FROZEN":
        deg[rows] = deg[first - 1]
    else:
        deg[rows, 1] = deg[first - 1, 1]
    return replace(flight, measured_deg=deg), rows


@pytest.mark.parametrize(
    ("reason", "suffix"),
    [
        (reason, suffix)
        for reason in REASONS
        for suffix in FORMATS
        # Positions come in steps of a converter, or in a sensor's own unit, and equal no command.
        if (reason, suffix) not in {("ECHO", ".bin"), ("ECHO", ".mat")}
    ],
)
def test_each_reason_is_marked_in_each_format(reason: str, suffix: str, tmp_path: Path) -> None:
    flight, rows = spoilt(flown(suffix), reason)
    path = tmp_path / f"flight{suffix}"
    write_flight(path, flight, aircraft_for(suffix))
    log = one_log(path)
    aircraft = surfaces_of(log, aircraft_for(suffix))
    # The writer's voltage and current go on while the position is held, as those of a servo do that jams.
    quiet = {name: entry.model_copy(update={"alive": ()}) for name, entry in aircraft.surfaces.items()}
    series = cut(log, flight.surfaces[1], aircraft.model_copy(update={"surfaces": quiet}))
    marked = series.why == Why[reason]
    found_s = np.flatnonzero(marked)
    assert marked.size == rows.size
    assert np.count_nonzero(marked & rows) >= 0.8 * np.count_nonzero(rows)
    assert np.count_nonzero(marked & ~rows) <= 0.01 * rows.size, found_s  # coarse readings repeat by chance
    assert np.isfinite(series.measured_deg[marked]).any() == (Why[reason] <= LAST_WITH_VALUE)


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_clean_flight_has_none_but_its_unknown_beginning(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"flight{suffix}"
    write_flight(path, flown(suffix), aircraft_for(suffix))
    log = one_log(path)
    aircraft = surfaces_of(log, aircraft_for(suffix))
    measured = [name for name, surface in aircraft.surfaces.items() if surface.measured is not None]
    for name in measured:
        assert [each.why for each in cut(log, name, aircraft).left_out] == ["unsettled"]
    # What the log itself says: another boot, a servo without power.
    channel = aircraft.surfaces[measured[0]].measured
    assert channel is not None
    time_s = log[channel.channel].time_s
    off = (time_s > time_s[500]) & (time_s < time_s[600])
    power = Channel("torque_enabled", time_s, 1.0 - off, "", "torque_enabled")
    reboot = Damage("reboot", "the clock starts again", 1, float(time_s[1399]), float(time_s[1400]))
    spoilt_log = replace(log, channels={**log.channels, power.name: power}, damage=(reboot,))
    why = cut(spoilt_log, measured[0], aircraft).why
    np.testing.assert_array_equal(why == Why.TORQUE_OFF, off)
    np.testing.assert_array_equal(why == Why.BOOT, time_s >= time_s[1400])


@pytest.mark.slow
def test_every_verb_sees_the_same_marks(tmp_path: Path) -> None:
    flight, _ = spoilt(flown(), "FROZEN")
    path = tmp_path / "flight.bin"
    write_flight(path, flight, load_aircraft("simulated"))
    aircraft, name = load_aircraft("simulated"), flight.surfaces[1]
    log = one_log(path)
    why = cut(log, name, surfaces_of(log, aircraft)).why
    (result,) = audit(path, Job(aircraft=aircraft))
    audited = next(surface.segment for surface in result.surfaces if surface.surface == name)
    calibrated = flights_of(path, aircraft)[name][0].segment
    (identified,) = bench_tests(path, aircraft, name)
    for series in (audited, calibrated, identified.segment):
        assert series is not None
        np.testing.assert_array_equal(series.why, why)


@pytest.mark.slow
@pytest.mark.parametrize("reason", ["FROZEN", "HELD", "DUPLICATE", "ECHO", "SPIKE"])
@pytest.mark.parametrize("at_once", [1, 7])
def test_a_stream_passes_on_what_a_log_keeps(reason: str, at_once: int, tmp_path: Path) -> None:
    flight, _ = spoilt(flown(), reason)
    path = tmp_path / "flight.csv"
    write_flight(path, flight, load_aircraft("simulated"))
    log = one_log(path)
    aircraft = surfaces_of(log, load_aircraft("simulated"))
    bus, watches = Bus(list(aircraft.surfaces)), {name: Watch() for name in aircraft.surfaces}
    passed: dict[str, list[float]] = {name: [] for name in watches}
    series = {name: cut(log, name, aircraft, bus_of(log, aircraft)) for name in watches}
    read = {name: log[entry.measured.channel] for name, entry in aircraft.surfaces.items() if entry.measured}
    for first in range(0, flight.time_s.size, at_once):
        rows = slice(first, first + at_once)
        new = {
            name: New(each.command_s[rows], each.command_deg[rows], read[name].time_s[rows], read[name].values[rows])
            for name, each in series.items()
        }
        stands = bus.take(new)
        for name, came in new.items():
            row = watches[name].take(came.time_s, came.position_deg, came.command_deg, stands=stands[name])
            passed[name] += [at_s for at_s, _ in row]
    for name, each in series.items():
        passed[name] += [at_s for at_s, _ in watches[name].finish()]
        assert passed[name] == each.measured_s[each.why <= LAST_WITH_VALUE].tolist(), name


def table(path: Path, columns: dict[str, FloatArray]) -> Path:
    np.savetxt(path, np.column_stack(list(columns.values())), delimiter=",", header=",".join(columns), comments="")
    return path


TIME_S = np.arange(0.0, 30.0, 0.02)
LATE_ROWS = 7
"""Of these, after a bus that stood: commands came late as well."""
ASKED_DEG = 10.0 * np.sin(2.0 * TIME_S)


def followed(rng: np.random.Generator) -> FloatArray:
    return 10.0 * np.sin(2.0 * TIME_S - 0.1) + 0.05 * rng.standard_normal(TIME_S.size)


def one(path: Path, **columns: FloatArray) -> Series:
    named = {"time_s": TIME_S, "rudder_cmd_deg": ASKED_DEG} | columns
    return cut(one_log(table(path, named)), "rudder", plain_aircraft(["rudder"]))


def test_where_the_torque_is_off_nothing_counts(tmp_path: Path) -> None:
    off = (TIME_S >= 12.0) & (TIME_S < 14.0)
    position_deg = followed(np.random.default_rng(1))
    series = one(tmp_path / "a.csv", rudder_pos_deg=position_deg, torque_enabled=np.where(off, 0.0, 1.0))
    np.testing.assert_array_equal(series.why == Why.TORQUE_OFF, off)
    assert [each.why for each in series.left_out] == ["unsettled", "torque off"]


def test_one_servo_that_stands_still_alone_is_jammed_and_not_frozen(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    columns = {"time_s": TIME_S}
    for k, name in enumerate(("rudder", "aileron", "elevator")):
        columns |= {
            f"{name}_cmd_deg": ASKED_DEG * (k != 2),
            f"{name}_pos_deg": followed(rng) if k < 2 else 0.0 * TIME_S,
        }
    columns["elevator_pos_deg"] = np.round(0.02 * rng.standard_normal(TIME_S.size), 1)  # at rest, and coarse
    columns["rudder_pos_deg"][700:] = columns["rudder_pos_deg"][700]
    log = one_log(table(tmp_path / "a.csv", columns))
    aircraft = plain_aircraft(["rudder", "aileron", "elevator"])
    assert not (cut(log, "rudder", aircraft).why == Why.FROZEN).any()
    # A jam beside a servo at rest whose reading never changes is a jam as well.
    assert not (cut(log, "rudder", plain_aircraft(["rudder", "elevator"])).why == Why.FROZEN).any()


def test_servos_that_come_to_rest_together_are_not_frozen(tmp_path: Path) -> None:
    """An arm that is let go: no command changes any more, and one joint never reached what it was asked."""
    rng, rests = np.random.default_rng(4), TIME_S >= 20.0
    columns = {"time_s": TIME_S}
    for k, name in enumerate(("rudder", "aileron", "elevator")):
        asked_deg = np.where(rests, ASKED_DEG[999], ASKED_DEG + 0.1 * np.round(rng.standard_normal(TIME_S.size)))
        position_deg = followed(rng) if k < 2 else np.where(TIME_S < 5.0, followed(rng), 2.0)
        position_deg[TIME_S >= 20.4] = position_deg[1019]
        columns |= {f"{name}_cmd_deg": asked_deg, f"{name}_pos_deg": position_deg}
    log = one_log(table(tmp_path / "a.csv", columns))
    aircraft = plain_aircraft(["rudder", "aileron", "elevator"])
    for name in aircraft.surfaces:
        series = cut(log, name, aircraft)
        assert not series.frozen_to_end, name
        assert not (series.why[TIME_S > 21.0] == Why.FROZEN).any(), name


def test_a_command_that_was_never_sent_is_left_out(tmp_path: Path) -> None:
    asked_deg = ASKED_DEG.copy()
    asked_deg[[600, 601]] = 60.0
    position_deg = followed(np.random.default_rng(3))
    series = one(tmp_path / "a.csv", rudder_cmd_deg=asked_deg, rudder_pos_deg=position_deg)
    assert TIME_S.size - series.command_s.size == 2
    assert series.command_deg.max() < 11.0


def test_an_echo_of_the_whole_command_is_no_measurement(tmp_path: Path) -> None:
    with pytest.raises(NoMeasurement, match="an echo of the command"):
        one(tmp_path / "a.csv", rudder_pos_deg=ASKED_DEG)


@pytest.mark.parametrize(
    ("hz", "rows"), [(1.0, 30), (50.0, 2), (20_000.0, 2000)], ids=["1 Hz", "two samples", "20 kHz"]
)
def test_odd_logs_make_a_series_or_say_why_not(tmp_path: Path, hz: float, rows: int) -> None:
    time_s = np.arange(rows) / hz
    columns = {
        "time_s": time_s,
        "rudder_cmd_deg": 500.0 * np.sign(np.sin(7.0 * time_s + 0.1)),
        "rudder_pos_deg": 500.0 * np.sin(7.0 * time_s),
    }
    columns["rudder_pos_deg"][rows // 2 : rows // 2 + rows // 10] = np.nan
    series = cut(one_log(table(tmp_path / "a.csv", columns)), "rudder", plain_aircraft(["rudder"]))
    assert series.measured_s.size == rows
    assert series.why.dtype == np.int8


def fleet(tmp_path: Path, seed: int, asked_deg: dict[str, FloatArray], dead: BoolArray) -> dict[str, BoolArray]:
    """Rows that are frozen, by surface, where the telemetry of all of them repeats in some rows."""
    rng = np.random.default_rng(seed)
    columns = {"time_s": TIME_S}
    for name, deg in asked_deg.items():
        position_deg = np.round(np.interp(TIME_S - 0.05, TIME_S, deg) + 0.05 * rng.standard_normal(TIME_S.size), 2)
        position_deg[dead] = position_deg[np.flatnonzero(dead)[0] - 1] if dead.any() else np.nan
        columns |= {f"{name}_cmd_deg": deg, f"{name}_pos_deg": position_deg}
    log = one_log(table(tmp_path / "a.csv", columns))
    aircraft = plain_aircraft(list(asked_deg))
    return {name: cut(log, name, aircraft).why == Why.FROZEN for name in asked_deg}


@pytest.mark.parametrize("seed", range(3))
def test_readings_that_stop_to_flicker_while_commands_stir_are_frozen(seed: int, tmp_path: Path) -> None:
    """Nobody is asked to move by half a degree: what tells it is noise that has gone."""
    stir_deg = 0.1 * np.random.default_rng([7, seed]).standard_normal(TIME_S.size)
    dead = (TIME_S >= 15.0) & (TIME_S < 15.6)
    still = {name: k + stir_deg for k, name in enumerate(("left", "right", "rudder"))}
    for found in fleet(tmp_path, seed, still, dead).values():
        assert np.count_nonzero(found & dead) >= np.count_nonzero(dead) - 1  # a reading may be what it was by chance
        assert np.count_nonzero(found & ~dead) <= 3 + LATE_ROWS
    # Where no command changes either, nothing tells a bus that stands still from servos that do.
    rest = {name: np.full(TIME_S.size, deg[0]) for name, deg in still.items()}
    assert not any(found.any() for found in fleet(tmp_path, seed, rest, dead).values())


def test_a_servo_that_has_sent_nothing_does_not_hide_that_the_others_stand_still(tmp_path: Path) -> None:
    dead = (TIME_S >= 15.0) & (TIME_S < 15.6)
    rng = np.random.default_rng(5)
    columns = {"time_s": TIME_S}
    for name in ("left", "right", "rudder"):
        columns |= {f"{name}_cmd_deg": ASKED_DEG, f"{name}_pos_deg": followed(rng)}
        columns[f"{name}_pos_deg"][dead] = np.nan if name == "rudder" else columns[f"{name}_pos_deg"][749]
    why = cut(one_log(table(tmp_path / "a.csv", columns)), "left", plain_aircraft(["left", "right", "rudder"])).why
    np.testing.assert_array_equal(why == Why.FROZEN, dead | ((TIME_S >= 15.6) & (TIME_S < 15.6 + LATE_ROWS / HZ)))


@pytest.mark.parametrize("rows", [1, 2, 4])
def test_a_slow_logger_may_hold_a_value_for_four_rows(rows: int, tmp_path: Path) -> None:
    time_s = np.arange(0.0, 60.0, 0.1)
    asked_deg = 12.0 * np.sin(1.5 * time_s)
    position_deg = np.round(12.0 * np.sin(1.5 * (time_s - 0.05)), 2)
    held = np.zeros(time_s.size, dtype=bool)
    for first in range(100, 500, 42):  # three in a period: in motion as at its turns
        held[first : first + rows] = True
        position_deg[first : first + rows] = position_deg[first - 1]
    columns = {"time_s": time_s, "rudder_cmd_deg": asked_deg, "rudder_pos_deg": position_deg}
    series = cut(one_log(table(tmp_path / "a.csv", columns)), "rudder", plain_aircraft(["rudder"]))
    marked = np.isin(series.why, (Why.HELD, Why.DUPLICATE))
    moved_deg = np.abs(position_deg - 12.0 * np.sin(1.5 * (time_s - 0.05)))
    assert marked[held & (moved_deg > 3.0)].all()  # more than a servo at its turn moves
    assert not marked[~held].any()


def test_a_servo_that_rests_at_its_stop_and_leaves_it_fast_is_not_held(tmp_path: Path) -> None:
    asked_deg = 12.0 * np.sin(15.0 * TIME_S)
    position_deg = np.clip(np.round(12.0 * np.sin(15.0 * (TIME_S - 0.05)), 2), -8.0, 8.0)
    series = one(tmp_path / "a.csv", rudder_cmd_deg=asked_deg, rudder_pos_deg=position_deg)
    assert not series.repeats.any()


def test_a_reading_that_jumps_onto_a_command_at_rest_is_its_echo(tmp_path: Path) -> None:
    """A servo at rest 1.4 deg beside its command does not jump onto it, bit for bit, without being asked."""
    rng = np.random.default_rng(3)
    position_deg = 0.2 * np.round(5.0 * (-1.4 + 0.06 * rng.standard_normal(TIME_S.size)))
    echo = (TIME_S >= 12.0) & (TIME_S < 13.4)
    position_deg[echo] = 0.0
    series = one(tmp_path / "a.csv", rudder_cmd_deg=np.zeros(TIME_S.size), rudder_pos_deg=position_deg)
    np.testing.assert_array_equal(series.why == Why.ECHO, echo)


def test_a_slow_servo_that_arrives_at_its_command_is_no_echo(tmp_path: Path) -> None:
    time_s = np.arange(0.0, 30.0, 0.1)
    asked_deg = np.where(time_s % 6.0 < 3.0, 12.0, 0.0)
    position_deg = asked_deg.copy()
    for first in np.flatnonzero(np.diff(asked_deg)).tolist():  # 1 s for 12 deg, the last of it in one reading
        share = np.minimum(np.arange(11) / 10.0, 0.9)
        share[-1] = 1.0
        position_deg[first : first + 11] = asked_deg[first] + share * (asked_deg[first + 1] - asked_deg[first])
    columns = {"time_s": time_s, "rudder_cmd_deg": asked_deg, "rudder_pos_deg": position_deg}
    series = cut(one_log(table(tmp_path / "a.csv", columns)), "rudder", plain_aircraft(["rudder"]))
    assert not (series.why == Why.ECHO).any()


@pytest.mark.parametrize("is_known_to_hold", [False, True])
def test_an_extreme_is_held_where_a_value_was_held_just_before(is_known_to_hold: bool, tmp_path: Path) -> None:
    """A servo in rough motion may rest at a stop; a telemetry that held a value just before may hold that one."""
    time_s = np.arange(0.0, 30.0, 0.1)
    moving_deg = np.round(3.0 * np.random.default_rng(4).uniform(-1.0, 1.0, time_s.size), 1)
    position_deg, first = moving_deg.copy(), 200
    position_deg[first : first + 5] = 4.0  # beyond all that came before
    position_deg[first + 5] = 7.0
    if is_known_to_hold:
        position_deg[first - 6] = 1.2
        position_deg[first - 5 : first - 2] = 0.2
        position_deg[first - 2] = -1.5
    columns = {"time_s": time_s, "rudder_cmd_deg": moving_deg, "rudder_pos_deg": position_deg}
    series = cut(one_log(table(tmp_path / "a.csv", columns)), "rudder", plain_aircraft(["rudder"]))
    assert (series.why[first + 1 : first + 5] == Why.HELD).tolist() == [is_known_to_hold] * 4


@pytest.mark.parametrize("rows", [1, 2, 3])
def test_a_spike_in_a_flight_with_much_manoeuvring_is_marked(rows: int, tmp_path: Path) -> None:
    rng = np.random.default_rng([8, rows])
    position_deg, thrown = followed(rng), np.zeros(TIME_S.size, dtype=bool)
    for first in range(100, 1400, 130):
        thrown[first : first + rows] = True
        position_deg[first : first + rows] += rng.choice([-1.0, 1.0]) * rng.uniform(6.0, 40.0)
    series = one(tmp_path / "a.csv", rudder_pos_deg=position_deg)
    np.testing.assert_array_equal(series.why == Why.SPIKE, thrown)


def test_a_spike_in_turbulence_is_marked_and_a_doublet_that_was_asked_for_is_not(tmp_path: Path) -> None:
    """Commands that step do not ask a surface to go out and come back."""
    time_s = np.arange(0.0, 60.0, 0.04)
    asked_deg = 7.0 * np.sign(np.sin(2.0 * np.pi * time_s))
    asked_deg[(time_s > 30.2) & (time_s < 30.27)] = 20.0
    position_deg = np.interp(time_s - 0.04, time_s, asked_deg) + 0.02 * np.random.default_rng(13).standard_normal(1500)
    thrown = np.isin(np.arange(1500), (110, 355, 860))
    position_deg[thrown] += 10.0
    columns = {"time_s": time_s, "rudder_cmd_deg": asked_deg, "rudder_pos_deg": position_deg}
    series = cut(one_log(table(tmp_path / "a.csv", columns)), "rudder", plain_aircraft(["rudder"]))
    np.testing.assert_array_equal(series.why == Why.SPIKE, thrown)


def test_an_overshoot_is_no_spike_and_a_spike_against_a_step_is_one() -> None:
    """The tip of an underdamped servo's overshoot goes out and back within 60 ms, but slows down first."""
    model = ServoModel.of(servo_named("s3151"))
    time_s = np.arange(0.0, 40.0, 0.02)
    asked_deg = 8.0 * np.sin(1.3 * time_s) + 6.0 * np.sign(np.sin(0.7 * time_s))
    position_deg = model.simulate(time_s, asked_deg, time_s) + 0.05 * np.random.default_rng(5).standard_normal(2000)
    thrown = np.isin(np.arange(2000), (700, 900, 901))
    position_deg[thrown] += np.array([20.0, -9.0, -9.0])
    none = np.zeros(time_s.size, dtype=np.int8)
    why, _ = marked(Rows(time_s, position_deg, asked_deg, none - 1, none))
    np.testing.assert_array_equal(why == Why.SPIKE, thrown)


def test_noise_is_no_spike() -> None:
    """Of a position that is noise of 1 deg, as of one that is read in another unit, hardly a row looks like one."""
    time_s, none = np.arange(0.0, 30.0, 0.01), np.zeros(3000, dtype=np.int8)
    noise_deg = np.random.default_rng(3).standard_normal(3000)
    why, _ = marked(Rows(time_s, noise_deg, 0.5 * np.sin(time_s), none - 1, none))
    assert np.count_nonzero(why == Why.SPIKE) <= 15


@pytest.mark.slow
def test_a_verdict_says_what_it_leaves_out_and_does_not_miss_positions_that_are_there(tmp_path: Path) -> None:
    """From 30 s on the position is the command, and 4 % of the readings before are spikes."""
    rng, time_s = np.random.default_rng(7), np.arange(0.0, 60.0, 0.02)
    asked_deg = 8.0 * np.sin(1.7 * time_s) + 4.0 * np.sin(4.1 * time_s)
    model = ServoModel.of(servo_named("hs225bb-eq31"))
    position_deg = model.simulate(time_s, asked_deg, time_s) + 0.05 * rng.standard_normal(time_s.size)
    position_deg[100:1500:10] = 80.0
    position_deg[time_s >= 30.0] = asked_deg[time_s >= 30.0]
    columns = {"time_s": time_s, "rudder_cmd_deg": asked_deg, "rudder_pos_deg": position_deg}
    (result,) = servofd.audit(table(tmp_path / "echo.csv", columns))
    (rudder,) = result.surfaces
    assert rudder.status == "unknown"
    assert "no position that counts after 30.0 s although commands go on for 30.0 s" in rudder.reason
    assert "left out: the command itself (50% of its readings), spikes (5%)" in rudder.reason


@pytest.mark.slow
def test_positions_in_microseconds_of_which_some_are_no_pulse_are_cut() -> None:
    """A pulse of 0 us is none: such a row has no position, for the bus as for the servo."""
    time_s = 0.1 * np.arange(600)
    asked_us = 1500.0 + 150.0 * np.sin(time_s)
    read_us = np.where(np.arange(600) % 7 == 3, 0.0, np.roll(asked_us, 1))
    table = {"t": time_s, "asked": asked_us, "read": read_us}
    found = servofd.audit(table, columns={"t": "time_s", "asked": "fin_cmd_us", "read": "fin_pos_us"})
    why = found.fin.segment.why
    assert np.all(why[read_us == 0.0] == Why.MISSING)
