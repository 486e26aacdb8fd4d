"""What a simulated vehicle sends at a time, and what it answers: without sockets, and without waiting."""

from __future__ import annotations

import io
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.generator.mavcrc import x25crc

import logparsers
from logparsers.codec import Codec
from logparsers.mavlink import Layout, dialect
from logparsers.protocol import RemoteLogCommand
from servofd.core.errors import ConfigError
from servofd.servo.faults import Stuck
from servofd.simulation.dataflash_writer import dataflash_log
from servofd.simulation.telemetry_writer import telemetry_log
from servofd.simulation.vehicle.vehicle import Schedule, Settings
from tests.live.vehicles import PLANE, ask, command, everything, fields, flown, said, vehicle

if TYPE_CHECKING:
    from collections.abc import Callable

    from servofd.simulation.vehicle.vehicle import Vehicle

SERVO, NAMED, ATTITUDE, HEARTBEAT = 36, 251, 30, 0
ACCEPTED, DENIED, UNSUPPORTED = 0, 2, 3
OUTPUTS = {"elevator": 2, "aileron": 1, "rudder": 4}


def test_it_flies_the_flight_that_the_file_simulator_writes() -> None:
    flight = flown()
    plane = vehicle(flight, any_rate=True)
    assert ask(plane, SERVO, 20_000) == ACCEPTED
    sent = everything(plane)
    log = logparsers.read(io.BytesIO(telemetry_log(flight, PLANE)))
    pulses = fields(sent, "SERVO_OUTPUT_RAW")
    for number in OUTPUTS.values():
        written = log[f"SERVO_OUTPUT_RAW.servo{number}_raw"].values
        assert [row[f"servo{number}_raw"] for row in pulses] == written.tolist()
        told = [row["value"] for row in fields(sent, "NAMED_VALUE_FLOAT") if row["name"] == f"SRVP{number}"]
        stored = log[f"NAMED_VALUE_FLOAT[SRVP{number}].value"].values
        assert np.array_equal(np.asarray(told, np.float32), stored.astype(np.float32))
    assert [row["time_usec"] for row in pulses] == plane.time_us.tolist()
    assert next(row["roll"] for row in fields(sent, "ATTITUDE")) == pytest.approx(log["ATTITUDE.roll"].values[0])


def test_at_40_hz_each_message_is_a_row_of_the_file_and_none_comes_twice() -> None:
    flight = flown()
    plane = vehicle(flight)
    assert ask(plane, SERVO, 25_000) == ACCEPTED
    stamps = np.array([row["time_usec"] for row in fields(everything(plane), "SERVO_OUTPUT_RAW")])
    assert set(stamps) <= set(plane.time_us)
    assert set(np.diff(stamps)) == {20_000, 40_000}  # as a real ArduPlane with a loop of 50 Hz sends them
    assert (stamps.size - 1) / (stamps[-1] - stamps[0]) * 1e6 == pytest.approx(40.0, rel=0.01)


def test_it_breaks_on_cue() -> None:
    plane = vehicle(flown(faults={"elevator": Stuck(5.0)}, noise_deg=0.0))
    rows = [row for row in fields(everything(plane), "NAMED_VALUE_FLOAT") if row["name"] == "SRVP2"]
    before = [row["value"] for row in rows if row["time_boot_ms"] < 4900]
    after = [row["value"] for row in rows if row["time_boot_ms"] > 5100]
    assert np.ptp(before) > 0.5
    assert np.ptp(after) == 0.0


@pytest.mark.parametrize(
    ("feedback", "arm_deg", "tolerance_deg"),
    [
        ("array", lambda row: row["data"][1], 1e-6),
        ("port", lambda row: 0.09 * (row["servo2_raw"] - 1500), 0.5 * 0.09),
    ],
)
def test_positions_are_the_same_in_each_message(
    feedback: str, arm_deg: Callable[[Any], float], tolerance_deg: float
) -> None:
    flight = flown()
    name = "DEBUG_FLOAT_ARRAY" if feedback == "array" else "SERVO_OUTPUT_RAW"
    sent = everything(vehicle(flight, feedback=feedback, message_hz=40.0))
    rows = [row for row in fields(sent, name) if feedback == "array" or row.get("port") == 2]
    at = np.searchsorted(np.round(flight.time_s * 1e6), [row["time_usec"] for row in rows])
    assert len(rows) > 390
    assert [arm_deg(row) for row in rows] == pytest.approx(
        flight.measured_deg[at, 0].tolist(), abs=tolerance_deg + 1e-9
    )


@settings(max_examples=60, deadline=None)
@given(loop_hz=st.sampled_from([50.0, 100.0, 300.0]), interval_us=st.integers(1, 3_000_000))
def test_rates_are_granted_as_ardupilot_grants_them(loop_hz: float, interval_us: int) -> None:
    loop_us = round(1e6 / loop_hz)
    schedule = Schedule({"X": 1000}, loop_us=loop_us)
    interval_ms = max(interval_us // 1000, 1)
    granted = schedule.ask("X", interval_us)
    assert granted == (interval_ms * 800 >= loop_us)
    if not granted:
        return
    turns = np.arange(round(20 * loop_hz)) * loop_us
    count = sum(bool(schedule.due(int(at_us))) for at_us in turns)
    assert abs(count - turns[-1] / max(1000 * interval_ms, loop_us)) <= 1.0
    assert schedule.interval_us("X") == 1000 * interval_ms


def test_50_hz_are_denied_in_words_and_granted_when_allowed() -> None:
    answers = vehicle().receive(command(511, SERVO, 20_000), 0)
    pieces = fields(answers, "STATUSTEXT")
    words = "Requested rate for message ID 36 too fast. Increase SCHED_LOOP_RATE"
    assert "".join(piece["text"] for piece in sorted(pieces, key=lambda piece: piece["chunk_seq"])) == words
    assert len({piece["id"] for piece in pieces}) == 1
    assert all(len(piece["text"]) <= 50 for piece in pieces)
    assert answers[-1].fields["result"] == DENIED
    assert ask(vehicle(any_rate=True), SERVO, 20_000) == ACCEPTED


def test_what_it_cannot_do_it_says() -> None:
    plane = vehicle()
    assert ask(plane, 59_999, 100_000) == DENIED
    assert ask(plane, SERVO, -2) == DENIED
    assert plane.receive(command(400, 1), 0)[0].fields["result"] == UNSUPPORTED  # arming
    assert plane.receive(command(511, float("nan"), 1e5), 0)[0].fields["result"] == DENIED
    assert plane.receive(command(511, SERVO, 1e5, target_system=2), 0) == []
    assert plane.receive(command(511, SERVO, 1e5, sender=(1, 1)), 0) == []
    assert plane.receive(said("HEARTBEAT"), 0) == []


def test_intervals_can_be_read_back_stopped_and_reset() -> None:
    plane = vehicle()

    def told() -> Any:
        return fields(plane.receive(command(510, SERVO), 0), "MESSAGE_INTERVAL")[0]["interval_us"]

    assert told() == 1_000_000
    assert (ask(plane, SERVO, 25_999), told()) == (ACCEPTED, 25_000)  # whole milliseconds
    assert (ask(plane, SERVO, -1), told()) == (ACCEPTED, -1)
    assert fields(everything(plane), "SERVO_OUTPUT_RAW") == []
    assert (ask(plane, SERVO, 0), told()) == (ACCEPTED, 1_000_000)
    plane.receive(said("REQUEST_DATA_STREAM", req_stream_id=3, req_message_rate=4, start_stop=1), 0)
    assert told() == 250_000  # a ground station's habit overrides what was asked for, as on the real one
    plane.receive(said("REQUEST_DATA_STREAM", req_stream_id=0, req_message_rate=50, start_stop=1), 0)
    assert told() == 25_000


def test_single_messages_can_be_requested() -> None:
    plane = vehicle()
    names = [message.name for message in plane.receive(command(512, SERVO), 1_000_000)]
    assert names == ["COMMAND_ACK", "SERVO_OUTPUT_RAW"]
    version = plane.receive(command(512, 148), 0)[1]
    assert (version.name, version.fields["flight_sw_version"] >> 24) == ("AUTOPILOT_VERSION", 4)
    assert plane.receive(command(512, 1), 0)[0].fields["result"] == DENIED
    assert plane.receive(said("MISSION_REQUEST_LIST"), 0)[0].fields.get("count", 0) == 0


def test_every_parameter_comes_once_with_its_place() -> None:
    plane = vehicle()
    plane.receive(said("PARAM_REQUEST_LIST"), 0)
    listed = fields(everything(plane), "PARAM_VALUE")
    assert [row["param_index"] for row in listed] == list(range(len(listed)))
    assert {row["param_count"] for row in listed} == {len(listed)}
    values = {row["param_id"]: row["param_value"] for row in listed}
    assert len(values) == len(listed)
    assert (values["SERVO2_FUNCTION"], values["SERVO2_MAX"], values["SCHED_LOOP_RATE"]) == (19.0, 2000.0, 50.0)
    (single,) = plane.receive(said("PARAM_REQUEST_READ", param_id="SERVO2_MAX", param_index=-1), 0)
    assert (single.fields["param_value"], single.fields["param_type"]) == (2000.0, 4)
    (first,) = plane.receive(said("PARAM_REQUEST_READ", param_index=0), 0)
    assert first.fields == listed[0]
    assert plane.receive(said("PARAM_REQUEST_READ", param_id="NONSENSE", param_index=-1), 0) == []
    assert plane.receive(said("PARAM_REQUEST_READ", param_index=999), 0) == []


def test_the_clock_wraps_after_71_6_minutes() -> None:
    flight = flown()
    plane = vehicle(replace(flight, time_s=np.round(flight.time_s + 4290.0, 6)), message_hz=40.0)
    sent = everything(plane)
    stamps = np.array([row["time_usec"] for row in fields(sent, "SERVO_OUTPUT_RAW")])
    assert np.count_nonzero(np.diff(stamps) < 0) == 1
    assert set(np.diff(stamps) % 2**32) == {20_000, 40_000}
    boot_ms = [row["time_boot_ms"] for row in fields(sent, "NAMED_VALUE_FLOAT")]
    assert (boot_ms[0], boot_ms[-1]) == (4_290_020, 4_300_000)


def test_timesync_tells_the_clock_in_nanoseconds() -> None:
    (answer,) = vehicle().receive(said("TIMESYNC", tc1=0, ts1=77), 1_234_567)
    assert (answer.fields["tc1"], answer.fields["ts1"]) == (1_234_567_000, 77)
    assert vehicle().receive(said("TIMESYNC", tc1=5, ts1=77), 0) == []


def status(seqno: int, arrived: bool = True, **options: Any) -> Any:
    return said("REMOTE_LOG_BLOCK_STATUS", seqno=seqno, status=int(arrived), **options)


def streamed(plane: Vehicle, *, from_turn: int = 0, loss: float = 0.0) -> dict[int, bytes]:
    """Fly with a client that acknowledges what it gets; both ways lose messages."""
    rng = np.random.default_rng(1)
    blocks: dict[int, bytes] = {}
    for index in range(plane.time_us.size):
        now_us = int(plane.time_us[index])
        if index == from_turn:
            plane.receive(status(RemoteLogCommand.START), now_us)
        for row in fields(plane.turn(index), "REMOTE_LOG_DATA_BLOCK"):
            if rng.random() >= loss:
                blocks[row["seqno"]] = bytes(row["data"])
                if rng.random() >= loss:
                    plane.receive(status(row["seqno"]), now_us)
    return blocks


def joined(blocks: dict[int, bytes]) -> bytes:
    assert sorted(blocks) == list(range(len(blocks)))
    return b"".join(blocks[number] for number in sorted(blocks))


@pytest.mark.parametrize("loss", [0.0, 0.05, 0.3])
def test_the_streamed_log_is_the_file_that_the_simulator_writes(loss: float) -> None:
    flight = flown()
    plane = vehicle(flight)
    blocks = streamed(plane, loss=loss)
    end = min(set(range(max(blocks) + 2)) - set(blocks))  # what was lost at the very end was not sent again
    content = joined({number: blocks[number] for number in range(end)})
    assert plane.dropped_rows == 0
    live = logparsers.read(io.BytesIO(content))
    file = logparsers.read(io.BytesIO(dataflash_log(flight, PLANE)))
    assert set(live.channels) == set(file.channels)
    for name in file.channels:
        values = live[name].values
        assert values.size > 0.9 * file[name].values.size - 2
        assert np.array_equal(values, file[name].values[: values.size], equal_nan=True)
    changed = {name for name, _ in live.parameters.items() ^ file.parameters.items()}
    assert changed == {"LOG_BACKEND_TYPE", "SCHED_LOOP_RATE", "SCR_ENABLE", "SERVO_RATE", "SYSID_THISMAV"}


def test_a_client_that_comes_late_gets_definitions_and_the_rest() -> None:
    plane = vehicle()
    log = logparsers.read(io.BytesIO(joined(streamed(plane, from_turn=250))))
    assert log.parameters["SERVO2_FUNCTION"] == 19.0
    assert log["RCOU.C2"].time_s[0] == pytest.approx(5.02, abs=1e-6)
    assert log["CSRV[1].Pos"].values.size > 240


def test_a_client_that_falls_silent_is_given_up_and_may_come_back() -> None:
    plane = vehicle(flown(duration_s=30.0))
    plane.receive(status(RemoteLogCommand.START), 0)
    sent = [fields(plane.turn(index), "REMOTE_LOG_DATA_BLOCK") for index in range(1000)]
    assert {row["seqno"] for rows in sent for row in rows} == set(range(39))  # the buffer, over and over
    assert plane.dropped_rows > 500
    last = max(index for index, rows in enumerate(sent) if rows)
    assert plane.time_us[last] == pytest.approx(10_000_000, abs=300_000)
    plane.receive(status(RemoteLogCommand.START), int(plane.time_us[1000]))
    assert [row["seqno"] for row in fields(plane.turn(1001), "REMOTE_LOG_DATA_BLOCK")] == list(range(8))


def test_blocks_go_to_the_first_client_until_it_stops() -> None:
    plane = vehicle()
    plane.receive(status(RemoteLogCommand.START), 0)
    plane.receive(status(RemoteLogCommand.START, sender=(254, 1)), 0)
    plane.receive(status(RemoteLogCommand.STOP, sender=(254, 1)), 0)
    rows = fields(plane.turn(0), "REMOTE_LOG_DATA_BLOCK")
    assert [row["seqno"] for row in rows] == list(range(8))
    assert {(row["target_system"], row["target_component"]) for row in rows} == {(255, 190)}
    plane.receive(status(0, arrived=False), int(plane.time_us[0]))
    assert 0 in [row["seqno"] for row in fields(plane.turn(1), "REMOTE_LOG_DATA_BLOCK")]
    plane.receive(status(RemoteLogCommand.STOP), 0)
    assert fields(plane.turn(2), "REMOTE_LOG_DATA_BLOCK") == []


@pytest.mark.slow
def test_nothing_that_is_said_to_it_brings_it_down() -> None:
    rng = np.random.default_rng(4)
    plane, own = vehicle(), Codec(1, 1)
    answered: set[str] = set()
    names = ["COMMAND_LONG", "COMMAND_INT", "REQUEST_DATA_STREAM", "PARAM_REQUEST_READ", "PARAM_SET", "TIMESYNC"]
    names += ["MISSION_REQUEST_LIST", "REMOTE_LOG_BLOCK_STATUS", "AUTOPILOT_VERSION_REQUEST", "PARAM_REQUEST_LIST"]
    for turn in range(plane.time_us.size):
        for name in names:
            layout = dialect().layouts[name]
            payload = bytearray(rng.bytes(layout.size))
            for key in {"target_system", "target_component"} & set(layout.fields):
                payload[layout.fields[key].offset] = 1
            if "command" in layout.fields:
                number = layout.fields["command"]
                payload[number.offset : number.offset + 2] = int(rng.integers(509, 521)).to_bytes(2, "little")
            (heard,) = Codec(9, 9).decode(frame(layout, bytes(payload)))
            for message in (*plane.receive(heard, int(plane.time_us[turn])), *plane.turn(turn)):
                answered.add(message.name)
                assert own.encode(*message)
    assert answered >= {"COMMAND_ACK", "MESSAGE_INTERVAL", "AUTOPILOT_VERSION", "PARAM_VALUE", "MISSION_COUNT"}


def frame(layout: Layout, payload: bytes) -> bytes:
    """Frame of version 2 around any payload."""
    body = bytes([len(payload), 0, 0, 0, 255, 190]) + layout.id.to_bytes(3, "little") + payload
    crc = x25crc(body)
    crc.accumulate(bytes([layout.seed]))
    return b"\xfd" + body + int(crc.crc).to_bytes(2, "little")


@pytest.mark.parametrize(
    "wrong",
    [
        {"system": 0},
        {"system": 256},
        {"feedback": "telepathy"},
        {"message_hz": -1.0},
        {"speed": 0.0},
        {"speed": np.nan},
    ],
)
def test_settings_that_make_no_sense_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        Settings(**wrong)
