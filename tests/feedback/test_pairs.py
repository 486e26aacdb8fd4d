"""Which position belongs to which output."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import logparsers
from logparsers import Channel, FlightLog
from logparsers.telemetry.encode import Message, encode
from servofd import audit
from servofd.aircraft.outputs import find_pairs, find_positions
from servofd.aircraft.schema import load_aircraft
from servofd.core.errors import NoMeasurement
from servofd.detection.audit import audit_log
from servofd.feedback.draft import draft_aircraft, draft_to_toml, what_to_log
from servofd.feedback.fitted import scaled_aircraft
from servofd.feedback.flown import flown_aircraft, surfaces_of
from servofd.servo.faults import Stuck
from servofd.servo.library import servo_named
from servofd.servo.servo_model import ServoModel
from servofd.simulation.commands import flight
from servofd.simulation.flight import simulate_flight
from servofd.simulation.pulses import outputs_of
from servofd.simulation.telemetry_writer import telemetry_messages

TIME_S = np.arange(4000) / 50.0
FUNCTIONS = {1: 4, 2: 19, 3: 70, 4: 21}


def channel(name: str, values: object, unit: str = "") -> Channel:
    return Channel(name, TIME_S, np.asarray(values, dtype=float), unit, name.replace("[", "."))


def log_of(
    ids: list[int],
    *,
    base: int,
    unit: str = "deg",
    command_field: bool = False,
    parameters: dict[str, float] | None = None,
) -> FlightLog:
    """Log with pulses on four outputs and positions of some of them, ids counted from `base`."""
    channels = {}
    model = ServoModel.of(servo_named("s9254"))
    for output in range(1, 5):
        command_deg = np.round(flight(TIME_S, np.random.default_rng(output)), 1)
        channels[f"RCOU.C{output}"] = channel(f"RCOU.C{output}", 1500.0 + 10.0 * command_deg, "us")
        if output - 1 + base in ids:
            noise_deg = 0.05 * np.random.default_rng(output).standard_normal(TIME_S.size)
            position_deg = model.simulate(TIME_S, command_deg, TIME_S) + noise_deg
            stem = f"CSRV[{output - 1 + base}]"
            scale = np.pi / 180.0 if unit == "rad" else 1.0
            channels[f"{stem}.Pos"] = channel(f"{stem}.Pos", scale * position_deg, unit)
            if command_field:
                channels[f"{stem}.PosCmd"] = channel(f"{stem}.PosCmd", command_deg, "deg")
    known = {f"SERVO{n}_FUNCTION": float(f) for n, f in FUNCTIONS.items()} | (parameters or {})
    return FlightLog(Path("flight.bin"), "dataflash", channels, parameters=known, vehicle="fixed wing")


@pytest.mark.parametrize(
    ("base", "ids", "parameters"),
    [
        (0, [0, 1, 3], {}),  # an id of 0 exists
        (0, [1, 3], {"SERVO_VOLZ_MASK": float(0b1010)}),  # bits count from 0
        (1, [1, 2, 4], {"CAN_D1_UC_SRV_BM": float(0b1011)}),  # bit n - 1 stands for output n
        (0, [1, 3], {}),  # nothing but the data tells
        (1, [2, 4], {}),
    ],
)
def test_ids_are_paired_with_outputs(base: int, ids: list[int], parameters: dict[str, float]) -> None:
    pairs = find_pairs(log_of(ids, base=base, parameters=parameters))
    assert [pair.output.number for pair in pairs] == [i - base + 1 for i in ids]
    names = {1: "aileron", 2: "elevator", 4: "rudder"}
    assert [pair.surface for pair in pairs] == [names[pair.output.number] for pair in pairs]
    assert [pair.command for pair in pairs] == [f"RCOU.C{pair.output.number}" for pair in pairs]


def test_motors_are_left_out() -> None:
    pairs = find_pairs(log_of([0, 1, 2, 3], base=0))
    assert [pair.output.number for pair in pairs] == [1, 2, 4]


def test_what_the_servo_says_it_was_told_comes_first() -> None:
    pairs = find_pairs(log_of([0, 1], base=0, command_field=True))
    assert [pair.command for pair in pairs] == ["CSRV[0].PosCmd", "CSRV[1].PosCmd"]


@pytest.mark.slow
@pytest.mark.parametrize("unit", [pytest.param("deg", marks=pytest.mark.nightly), "rad"])
def test_the_scale_of_pulses_is_found(unit: str) -> None:
    draft = draft_aircraft(log_of([0, 1, 3], base=0, unit=unit))
    for surface in draft.surfaces.values():
        assert surface.command.model_dump()["slope_deg_per_us"] == pytest.approx(0.1, rel=0.02)
        assert surface.command.model_dump()["trim_us"] == pytest.approx(1500.0, abs=0.5)
        assert surface.model_dump()["measured"]["unit"] == unit
        assert surface.calibrated is not None
        assert surface.threshold_deg < 1.5


@pytest.mark.slow
def test_the_pulse_of_a_command_is_found_behind_the_lag_of_its_repetition() -> None:
    """A real ArduPlane has RCOU at 25 Hz and CSRV.PosCmd at 50 Hz, 20 to 30 ms later than the pulse."""
    log = log_of([0], base=0, command_field=True)
    late_s = 0.026
    pulses, angles = log["RCOU.C1"], log["CSRV[0].PosCmd"]
    steps = np.round(60.0 * np.random.default_rng(4).standard_normal(TIME_S.size // 10)).repeat(10)
    pulses = dataclasses.replace(pulses, time_s=TIME_S[::2], values=1500.0 + steps[::2])
    sent = np.searchsorted(TIME_S, TIME_S - late_s, side="right") - 1
    angles = dataclasses.replace(angles, values=0.2 * steps[np.maximum(sent, 0)])
    log = dataclasses.replace(log, channels={**log.channels, "RCOU.C1": pulses, "CSRV[0].PosCmd": angles})
    (surface,) = draft_aircraft(log).surfaces.values()
    assert list(surface.command.model_dump()["pulse"]) == pytest.approx([1500.0, 0.2], rel=1e-3)


@pytest.mark.slow
def test_the_drafted_file_is_accepted_as_it_is(tmp_path: Path) -> None:
    log = log_of([0, 1, 3], base=0, command_field=True)
    draft = draft_aircraft(log)
    config = tmp_path / "plane.toml"
    config.write_text(draft_to_toml(log, draft))
    loaded = load_aircraft(config)
    assert loaded.surfaces == draft.of_no_log().surfaces
    assert loaded.servos == draft.servos


def in_one_message(named: list[Message], message: str) -> Message:
    """Named values of the servos 1, 2 and 4 in one array or vector, as a companion computer sends them."""
    stamps = np.asarray(named[0].columns["time_boot_ms"], np.uint64) * np.uint64(1000)
    values = {int(np.asarray(m.columns["name"])[0][4:]): np.asarray(m.columns["value"], float) for m in named}
    columns: dict[str, Any] = {"time_usec": stamps, "name": ["SRVP"] * stamps.size}
    if message == "DEBUG_VECT":
        columns |= {"x": values[1], "y": values[2], "z": np.zeros(stamps.size)}
    else:
        data = np.zeros((stamps.size, 58))
        data[:, [number - 1 for number in values]] = np.column_stack(list(values.values()))
        columns |= {"array_id": np.full(stamps.size, 7), "data": data}
    return Message(message, named[0].arrival_us, columns)


@pytest.mark.slow
@pytest.mark.parametrize("message", ["DEBUG_FLOAT_ARRAY", "DEBUG_VECT"])
def test_arrays_and_vectors_of_telemetry_tell_positions(message: str, tmp_path: Path) -> None:
    plane = load_aircraft("simulated")
    flown = simulate_flight(
        plane, duration_s=60.0, rate_hz=50.0, seed=4, faults={"elevator": Stuck(30.0)}, outputs=outputs_of(plane)
    )
    sent = telemetry_messages(flown, plane)
    named = [one for one in sent if one.name == "NAMED_VALUE_FLOAT"]
    other = in_one_message(named, message)
    rig = Message(message, other.arrival_us, {**other.columns, "name": ["RIG"] * len(named[0].arrival_us)})  # type: ignore[arg-type]
    if message == "DEBUG_FLOAT_ARRAY":
        rig = Message(message, rig.arrival_us, {**rig.columns, "array_id": np.ones(len(named[0].arrival_us))})  # type: ignore[arg-type]
    others = [one for one in sent if one.name != "NAMED_VALUE_FLOAT"]
    found = {}
    for name, messages in {"named": named, "together": [other, rig]}.items():
        path = tmp_path / f"{name}.tlog"
        path.write_bytes(encode([*others, *messages]))
        (result,) = audit(path, plane)
        found[name] = {
            s.surface: (s.status, [(f.kind, round(f.start_s, 1)) for f in s.faults]) for s in result.surfaces
        }
    assert found["together"]["elevator"] == found["named"]["elevator"]
    assert found["named"]["elevator"][0] == "fault"
    shared = found["named"].keys() if message == "DEBUG_FLOAT_ARRAY" else {"aileron", "elevator"}
    assert {name: found["together"][name] for name in shared} == {name: found["named"][name] for name in shared}
    positions = find_positions(logparsers.read(tmp_path / "together.tlog"))
    assert not [one.channel for one in positions if "RIG" in one.channel or "ARRAY[1]" in one.channel]
    assert len(find_pairs(logparsers.read(tmp_path / "together.tlog"))) == len(shared)


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("debug_key_value[0][SRVP3].value", 3),
        ("debug_array[0][SRVP].data[4]", 4),
        ("debug_vect[0][SRVP].z", 2),
        ("DEBUG_VECT[SRVP4].y", 5),
        ("1/191:DEBUG_VECT[SRVP].x", 0),
        ("debug_array[0][RIG].data[4]", None),
        ("DEBUG_VECT[TAIL].x", None),
        ("DEBUG_FLOAT_ARRAY[7].data[3]", None),
    ],
)
def test_which_channels_tell_positions(name: str, number: int | None) -> None:
    log = FlightLog(Path("a.ulg"), "ulog", {name: channel(name, np.sin(TIME_S))})
    assert [one.id for one in find_positions(log)] == ([] if number is None else [number])


def test_a_log_without_positions_says_what_to_log() -> None:
    with pytest.raises(NoMeasurement, match="SERVO_VOLZ_MASK"):
        draft_aircraft(log_of([], base=0))


def test_positions_in_another_unit_are_not_taken_for_degrees() -> None:
    with pytest.raises(NoMeasurement, match="is in us, not in deg or rad"):
        draft_aircraft(log_of([1, 2, 4], base=1, unit="us"))


def test_a_multirotor_is_called_one() -> None:
    for craft in ("quadrotor", "multirotor"):
        assert f"it is of a {craft}" in what_to_log(FlightLog(Path("a.bin"), "dataflash", {}, vehicle=craft))
    wing = what_to_log(FlightLog(Path("a.bin"), "dataflash", {}, vehicle="fixed wing"))
    assert wing.startswith("healthy flights of four days show what each axis loses: `servofd calibrate")
    assert "CSRV" in wing


def test_a_winged_vehicle_of_px4_is_told_of_calibration_and_no_sentence_lacks_its_object() -> None:
    for craft in ("fixed wing", "vtol fixedrotor"):
        said = what_to_log(FlightLog(Path("a.ulg"), "ulog", {}, vehicle=craft))
        assert said.startswith("healthy flights of four days")
        assert "for a verdict on each servo send the positions as DEBUG_FLOAT_ARRAY" in said
    for kind in ("dataflash", "tlog", "ulog"):
        unknown = what_to_log(FlightLog(Path("a.log"), kind, {}))
        assert unknown.startswith("for a verdict on each servo ")


@pytest.mark.parametrize(("scale", "what"), [(-1.0, "sign"), (8.0, "scale")])
def test_a_position_that_moves_against_its_command_in_degrees_or_by_many_times_as_much_is_suspected(
    scale: float, what: str
) -> None:
    log = log_of([0, 1], base=0, command_field=True)
    wrong = {"CSRV[0].Pos": dataclasses.replace(log["CSRV[0].Pos"], values=scale * log["CSRV[0].Pos"].values)}
    log = dataclasses.replace(log, channels={**log.channels, **wrong})
    sound, other = audit_log(log, flown_aircraft(log)).surfaces[::-1]
    assert sound.status == "healthy"
    assert other.status == "suspect"
    assert f"check the {what} of the calibration" in other.reason


def test_a_good_log_tells_the_scale_of_its_pulses_by_the_part_that_is_good_and_nothing_of_servos() -> None:
    log = log_of([0, 1], base=0)
    name, still = log["CSRV[0].Pos"].name, TIME_S > 40.0
    held = {name: dataclasses.replace(log[name], values=np.where(still, 15.0, 0.5 * log[name].values))}
    log = dataclasses.replace(log, channels={**log.channels, **held})
    found = scaled_aircraft(log, surfaces_of(log), ((0.0, 40.0),))
    assert not any(surface.names_servo for surface in found.surfaces.values())
    halved, whole = found.surfaces.values()
    pulses_us = np.array([1500.0, 1600.0])
    for surface, slope in ((halved, 0.05), (whole, 0.1)):
        low_deg, high_deg = surface.command.to_deg(pulses_us)
        assert abs((high_deg - low_deg) / 100.0 / slope - 1.0) < 0.02
        assert abs(low_deg) < 0.2
