"""Simulated logs of autopilots: the reference decoders read back every value, our own reader finds the truth."""

from __future__ import annotations

import contextlib
import io
import os
from collections import defaultdict
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from pymavlink import DFReader
from pyulog import ULog

import logparsers
from logparsers.dataflash.formats import CHARACTERS, TEXT
from servofd.aircraft.schema import Aircraft, load_aircraft, plain_aircraft
from servofd.cli import main
from servofd.core.errors import ConfigError
from servofd.servo.faults import Stuck
from servofd.simulation.dataflash_writer import GENERATIONS, Generation, dataflash_messages
from servofd.simulation.flight import SimulatedFlight, simulate_flight
from servofd.simulation.pulses import outputs_of
from servofd.simulation.telemetry_writer import telemetry_messages
from servofd.simulation.ulog_writer import ulog_parameters, ulog_topics
from servofd.simulation.writers import write_flight

if TYPE_CHECKING:
    from pathlib import Path

VOLZ_STEP_DEG = 200.0 / 3840.0
HALF_MICROSECOND_S = 6e-7


def plane() -> Aircraft:
    """Six surfaces, two of which report nothing, one that turns the other way."""
    aircraft = load_aircraft("faser")
    rudder = aircraft.surfaces["rudder"]
    turned = rudder.model_copy(update={"command": rudder.command.model_copy(update={"sign": -1})})
    return aircraft.model_copy(update={"surfaces": {**aircraft.surfaces, "rudder": turned}})


def fly(aircraft: Aircraft, *, duration_s: float = 12.0, rate_hz: float = 40.0, noise_deg: float = 0.1) -> Any:
    return simulate_flight(
        aircraft,
        duration_s=duration_s,
        rate_hz=rate_hz,
        seed=3,
        faults={"elevator": Stuck(8.5)},
        noise_deg=noise_deg,
        outputs=outputs_of(aircraft),
    )


@pytest.fixture(scope="module")
def aircraft() -> Aircraft:
    return plane()


@pytest.fixture(scope="module")
def flight(aircraft: Aircraft) -> SimulatedFlight:
    flown: SimulatedFlight = fly(aircraft)
    return flown


def stored(character: str, values: Any) -> list[Any]:
    """What is left of a column in the storage of its format character."""
    kind, divisor = CHARACTERS[character]
    column = np.asarray(values)
    if character in TEXT:
        return [str(value) for value in column]
    if divisor is not None:
        return (np.rint(column * divisor).astype(kind) / divisor).tolist()  # type: ignore[no-any-return]
    return column.astype(kind).tolist()  # type: ignore[no-any-return]


@pytest.mark.parametrize("generation", GENERATIONS.values(), ids=lambda g: g.name)
def test_pymavlink_reads_back_every_value_of_a_dataflash_log(
    aircraft: Aircraft, flight: SimulatedFlight, generation: Generation, tmp_path: Path
) -> None:
    path = tmp_path / "flight.bin"
    write_flight(path, flight, aircraft, generation=generation.name)
    rows = defaultdict(list)
    with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
        reader = DFReader.DFReader_binary(str(path))
        while (row := reader.recv_msg()) is not None:
            rows[row.get_type()].append(row)
        reader.close()
    assert set(rows) == {"FMT", "FMTU", "UNIT", "MULT", *(m.name for m in dataflash_messages(flight, aircraft))}
    for message in dataflash_messages(flight, aircraft, generation):
        for character, (name, values) in zip(message.format, message.columns.items(), strict=True):
            read = [getattr(row, name) for row in rows[message.name]]
            np.testing.assert_array_equal(read, stored(character, values), err_msg=f"{message.name}.{name}")
    layout = {row.Name: row.Type for row in rows["FMT"]}
    units = {row.FmtType: row.UnitIds for row in rows["FMTU"]}
    assert units[layout["CSRV"]] == generation.units


def test_mavutil_reads_back_every_value_of_a_telemetry_log(
    aircraft: Aircraft, flight: SimulatedFlight, tmp_path: Path
) -> None:
    os.environ["MAVLINK20"] = "1"
    from pymavlink import mavutil

    mavutil.set_dialect("all")
    path = tmp_path / "flight.tlog"
    write_flight(path, flight, aircraft)
    rows = defaultdict(list)
    log = mavutil.mavlogfile(str(path))
    while (row := log.recv_msg()) is not None:
        rows[row.get_type(), getattr(row, "name", "")].append(row)
    assert log.mav_loss == 0
    log.close()
    wanted = telemetry_messages(flight, aircraft)
    assert sum(map(len, rows.values())) == sum(np.size(m.arrival_us) for m in wanted)
    for message in wanted:
        label = str(np.asarray(message.columns["name"])[0]) if "name" in message.columns else ""
        found = rows[message.name, label]
        arrived = np.array([row._timestamp for row in found])
        np.testing.assert_allclose(arrived, np.asarray(message.arrival_us) * 1e-6, rtol=0, atol=HALF_MICROSECOND_S)
        assert {(row.get_srcSystem(), row.get_srcComponent()) for row in found} == {(1, 1)}
        for field, values in message.columns.items():
            read, want = np.array([getattr(row, field) for row in found]), np.asarray(values)
            if want.dtype.kind == "f":
                want = want.astype(np.float32)
            np.testing.assert_array_equal(read, want, err_msg=f"{message.name}.{field}")


def test_pyulog_reads_back_every_value_of_a_px4_log(
    aircraft: Aircraft, flight: SimulatedFlight, tmp_path: Path
) -> None:
    path = tmp_path / "flight.ulg"
    write_flight(path, flight, aircraft)
    log = ULog(str(path))
    data = {topic.name: topic.data for topic in log.data_list}
    assert not log.file_corruption
    assert set(data) == {topic.name for topic in ulog_topics(flight, aircraft)}
    for topic in ulog_topics(flight, aircraft):
        for name, values in topic.columns.items():
            if values.dtype.kind == "S":
                letters = values.view(np.uint8).reshape(len(values), -1)
                read = np.column_stack([data[topic.name][f"{name}[{k}]"] for k in range(letters.shape[1])])
                np.testing.assert_array_equal(read.astype(np.uint8), letters)
            elif values.ndim > 1:
                for k in range(values.shape[1]):
                    np.testing.assert_array_equal(data[topic.name][f"{name}[{k}]"], values[:, k])
            else:
                np.testing.assert_array_equal(data[topic.name][name], values)
    wanted = ulog_parameters(flight)
    assert set(log.initial_parameters) == set(wanted)
    assert log.initial_parameters == pytest.approx(wanted)
    assert {key: type(value) for key, value in wanted.items()} == {
        key: type(value) for key, value in log.initial_parameters.items()
    }
    assert log.msg_info_dict["sys_name"] == "PX4"
    assert [said.message for said in log.logged_messages] == ["[servofd] simulated flight"]


# -- the truth, through our own readers -------------------------------------------------------------------


@pytest.mark.parametrize("generation", GENERATIONS)
def test_dataflash_holds_the_truth(
    aircraft: Aircraft, flight: SimulatedFlight, generation: str, tmp_path: Path
) -> None:
    path = tmp_path / "flight.bin"
    write_flight(path, flight, aircraft, generation=generation)
    log = logparsers.read(path)
    assert (log.damage, log.vehicle) == ((), "fixed wing")
    assert log.firmware.startswith("ArduPlane V4.7.0-dev" if generation == "volz" else "ArduPlane V4.6.0")
    mask = int(log.parameters["SERVO_VOLZ_MASK" if generation == "volz" else "CAN_D1_UC_SRV_BM"])
    for i, output in enumerate(flight.outputs):
        n = output.number
        pulse = log[f"RCOU.C{n}"]
        assert pulse.unit == "us"
        np.testing.assert_allclose(pulse.time_s, flight.time_s, rtol=0, atol=HALF_MICROSECOND_S)
        np.testing.assert_array_equal(output.deflection_deg(pulse.values.astype(int)), flight.command_deg[:, i])
        assert log.parameters[f"SERVO{n}_REVERSED"] == (output.surface == "rudder")
        assert bool(mask >> (n - 1) & 1) == (not output.surface.startswith("flap"))
        number = n - 1 if generation == "volz" else n
        if output.surface.startswith("flap"):
            assert f"CSRV[{number}].Pos" not in log.channels
            continue
        position, current = log[f"CSRV[{number}].Pos"], log[f"CSRV[{number}].A"]
        if generation == "volz":
            assert position.unit == "deg"
            read_deg, tolerance_deg = position.values, VOLZ_STEP_DEG / 2 + 1e-5
            sent = log[f"CSRV[{number}].PosCmd"]
            np.testing.assert_allclose(output.arm_deg(sent.values), flight.command_deg[:, i], atol=1e-5)
            assert not current.is_constant
        else:
            assert position.unit == "rad"  # told by the reader: the log itself names no unit
            read_deg, tolerance_deg = np.degrees(position.values), 0.02
            assert not log[f"CSRV[{number}].Speed"].is_constant
            assert log[f"CSRV[{number}].PosCmd"].is_constant
        np.testing.assert_allclose(output.arm_deg(read_deg), flight.measured_deg[:, i], rtol=0, atol=tolerance_deg)
    assert log["POWR.VServo"].values.mean() == pytest.approx(7.4, abs=0.1)
    assert log["GPS[0].Lat"].unit == "deg"


def test_telemetry_holds_the_truth(aircraft: Aircraft, flight: SimulatedFlight, tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    write_flight(path, flight, aircraft)
    log = logparsers.read(path)
    assert (log.damage, log.vehicle) == ((), "fixed wing")
    assert log.firmware == "ArduPlane V4.7.0-dev (simulated by servofd)"
    for i, output in enumerate(flight.outputs):
        pulse = log[f"SERVO_OUTPUT_RAW.servo{output.number}_raw"]
        np.testing.assert_allclose(pulse.time_s, flight.time_s, rtol=0, atol=HALF_MICROSECOND_S)
        np.testing.assert_array_equal(pulse.values, flight.pulse_us[:, i])
        assert log.parameters[f"SERVO{output.number}_FUNCTION"] == output.function
        name = f"NAMED_VALUE_FLOAT[SRVP{output.number}].value"
        assert (name in log.channels) == (not output.surface.startswith("flap"))
        if name in log.channels:
            np.testing.assert_allclose(log[name].time_s, flight.time_s, rtol=0, atol=HALF_MICROSECOND_S)
            np.testing.assert_allclose(output.arm_deg(log[name].values), flight.measured_deg[:, i], atol=1e-5)


def test_px4_holds_the_truth(aircraft: Aircraft, flight: SimulatedFlight, tmp_path: Path) -> None:
    path = tmp_path / "flight.ulg"
    write_flight(path, flight, aircraft)
    log = logparsers.read(path)
    assert (log.damage, log.vehicle, log.firmware) == ((), "fixed wing", "PX4 1.15.0")
    for k, output in enumerate(flight.outputs):
        control, position = log[f"actuator_servos[0].control[{k}]"], log[f"debug_array[0][SRVP].data[{k}]"]
        np.testing.assert_allclose(control.time_s, flight.time_s, rtol=0, atol=HALF_MICROSECOND_S)
        np.testing.assert_allclose(control.values * output.travel_deg, flight.command_deg[:, k], atol=1e-5)
        assert log.parameters[f"PWM_MAIN_FUNC{output.number}"] == 201 + k
        if output.surface.startswith("flap"):
            assert np.isnan(position.values).all()
        else:
            np.testing.assert_allclose(output.arm_deg(position.values), flight.measured_deg[:, k], atol=1e-5)
    assert [log.parameters[f"CA_SV_CS{k}_TYPE"] for k in range(6)] == [3, 4, 1, 2, 9, 10]
    assert int(log.parameters["PWM_MAIN_REV"]) == 1 << 3


def test_clocks_overflow_and_the_reader_counts_on(tmp_path: Path) -> None:
    """`time_usec` has 32 bits: 71.6 minutes."""
    aircraft = plain_aircraft(["rudder"], "hs225bb-eq31")
    flown = fly_long(aircraft)
    path = tmp_path / "long.tlog"
    write_flight(path, flown, aircraft)
    (servos,) = (m for m in telemetry_messages(flown, aircraft) if m.name == "SERVO_OUTPUT_RAW")
    assert (np.diff(np.asarray(servos.columns["time_usec"])) < 0).sum() == 1
    pulse = logparsers.read(path)["SERVO_OUTPUT_RAW.servo4_raw"]
    np.testing.assert_allclose(pulse.time_s, flown.time_s, rtol=0, atol=HALF_MICROSECOND_S)
    np.testing.assert_array_equal(pulse.values, flown.pulse_us[:, 0])


def fly_long(aircraft: Aircraft) -> SimulatedFlight:
    return simulate_flight(
        aircraft, command="steps", duration_s=4320.0, rate_hz=5.0, seed=1, outputs=outputs_of(aircraft)
    )


def test_the_servo_receives_the_pulse_that_was_sent(aircraft: Aircraft) -> None:
    flown = fly(aircraft, noise_deg=0.0)
    for i, (name, output) in enumerate(zip(flown.surfaces, flown.outputs, strict=True)):
        np.testing.assert_array_equal(flown.command_deg[:, i], output.deflection_deg(flown.pulse_us[:, i]))
        healthy = aircraft.model(name).simulate(flown.time_s, flown.command_deg[:, i], flown.time_s)
        before = flown.time_s < 8.5 if name == "elevator" else np.full(flown.time_s.size, True)
        np.testing.assert_allclose(flown.measured_deg[before, i], healthy[before], rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ["a.bin", "a.tlog", "a.ulg"])
def test_the_same_seed_gives_the_same_bytes(name: str, tmp_path: Path) -> None:
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        assert main(["simulate", "-o", str(tmp_path / folder / name), "--duration", "5", "--seed", "4"]) == 0
    assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()


def test_the_command_line_chooses_rate_and_generation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "flight.bin"
    assert main(["simulate", "-o", str(path), "--duration", "5", "--generation", "dronecan"]) == 0
    assert "at 100 Hz" in capsys.readouterr().out
    assert logparsers.read(path).firmware.startswith("ArduPlane V4.6.0")
    path = tmp_path / "flight.tlog"
    assert main(["simulate", "-o", str(path), "--duration", "5"]) == 0
    assert "at 40 Hz" in capsys.readouterr().out
    assert main(["simulate", "-o", str(path), "--duration", "5", "--rate-hz", "25"]) == 0
    assert logparsers.read(path)["SERVO_OUTPUT_RAW.servo1_raw"].values.size == 125


def test_what_cannot_be_logged_is_refused(tmp_path: Path) -> None:
    three, nine = (
        plain_aircraft(["elevator"], "hs225bb-eq31"),
        plain_aircraft([f"surface{k}" for k in range(9)], "hs225bb-eq31"),
    )
    bare = simulate_flight(three, duration_s=2.0)
    for suffix in (".bin", ".tlog", ".ulg"):
        with pytest.raises(ConfigError, match="outputs_of"):
            write_flight(tmp_path / f"a{suffix}", bare, three)
    flown = simulate_flight(nine, duration_s=2.0, outputs=outputs_of(nine))
    with pytest.raises(ConfigError, match="room for 8"):
        write_flight(tmp_path / "a.ulg", flown, nine)
    with pytest.raises(ConfigError, match="in order"):
        simulate_flight(three, duration_s=2.0, outputs=outputs_of(nine))
    assert list(tmp_path.iterdir()) == []
