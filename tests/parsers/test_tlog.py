"""Telemetry logs: equal to pymavlink, whatever was sent and whatever was damaged."""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import time
import tracemalloc
from collections import Counter, defaultdict
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

import logparsers
from logparsers import mavlink, protocol
from logparsers.channels import LazyChannels
from logparsers.errors import EmptyLog, LogError, MissingLog, UnreadableLog
from logparsers.telemetry import Sender, TelemetryFile
from logparsers.telemetry.clock import TelemetryClock
from tests.parsers import tlog_writer as writer
from tests.parsers.external import real_logs

if TYPE_CHECKING:
    from pathlib import Path

CRAFT, COMPANION, STATION = Sender(1, 1), Sender(1, 191), Sender(255, 190)


def channels(log: TelemetryFile) -> LazyChannels:
    return LazyChannels(log)


def pymavlink_reads(path: Path, dialect: str = "all") -> list[Any]:
    os.environ["MAVLINK20"] = "1"
    from pymavlink import mavutil

    mavutil.set_dialect(dialect)
    log = mavutil.mavlogfile(str(path))
    try:
        found = []
        while (message := log.recv_msg()) is not None:
            if message.get_type() != "BAD_DATA" and not message.get_type().startswith("UNKNOWN"):
                found.append(message)
        return found
    finally:
        log.close()


def assert_equal_to_pymavlink(path: Path, dialect: str = "all") -> int:
    grouped = defaultdict(list)
    for message in pymavlink_reads(path, dialect):
        grouped[message.get_type()].append(message)
    log = TelemetryFile.open(path)
    assert {name: log.count(name) for name in log.messages} == {k: len(v) for k, v in grouped.items()}
    compared = 0
    for name, messages in grouped.items():
        stamps = np.array([m._timestamp for m in messages])
        np.testing.assert_array_equal(log.arrivals_us(log.stream(name)).astype(float) * 1e-6, stamps)
        senders = sorted({(m.get_srcSystem(), m.get_srcComponent()) for m in messages})
        assert list(log.sources(name)) == senders
        for field in log.layout(name).fields:
            ours = log.column(name, field)
            theirs = [getattr(m, field) for m in messages]
            if ours.dtype.kind == "f":
                want = np.array(theirs, dtype=np.float64)
                np.testing.assert_array_equal(ours.astype(np.float64), want)
                assert np.array_equal(np.signbit(ours), np.signbit(want))
            else:
                assert ours.tolist() == theirs
            compared += ours.size
    return compared


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    path = tmp_path / "flight.tlog"
    path.write_bytes(writer.flight())
    return path


# ------------------------------------------------------------------ values


@pytest.mark.slow
@pytest.mark.parametrize("most", [1, pytest.param(None, marks=pytest.mark.nightly)])
def test_every_value_of_real_logs_equals_pymavlinks(most: int | None) -> None:
    for path in sorted(real_logs(".tlog"), key=lambda path: path.stat().st_size)[:most]:
        assert assert_equal_to_pymavlink(path) > 10_000


def test_every_value_of_a_generated_log_equals_pymavlinks(flight: Path) -> None:
    assert assert_equal_to_pymavlink(flight) > 5_000


@pytest.mark.slow
@pytest.mark.parametrize(
    "dialect", ["all", *(pytest.param(d, marks=pytest.mark.slow) for d in ("matrixpilot", "paparazzi"))]
)
@pytest.mark.parametrize("version", [1, 2])
def test_every_message_of_every_dialect_is_decoded(tmp_path: Path, version: int, dialect: str) -> None:
    rng = np.random.default_rng(version)
    entries: list[tuple[float, bytes]] = []
    for name, layout in mavlink.dialect(dialect).layouts.items():
        if version == 1 and layout.id > 255:
            continue
        for k in range(3):
            values: dict[str, Any] = {}
            for field in layout.fields.values():
                if field.is_text:
                    values[field.name] = "AbC"[:k]
                elif field.dtype.kind == "f":
                    values[field.name] = rng.normal(size=max(field.length, 1)).tolist()
                else:
                    top = 2 ** (8 * field.dtype.itemsize - 1) - 1
                    values[field.name] = rng.integers(0, top, max(field.length, 1)).tolist()
            content = writer.frame(
                name,
                values,
                version=version,
                extensions=k < 2,
                signed=version == 2 and k == 2,
                dialect_name=dialect,
            )
            entries.append((len(entries) * 0.01, content))
    path = tmp_path / f"{dialect}.tlog"
    path.write_bytes(writer.log(entries))
    assert_equal_to_pymavlink(path, dialect)
    assert TelemetryFile.open(path).dialect == dialect
    assert TelemetryFile.open(path).lost_bytes == 0


def test_trailing_zeros_and_extensions_may_be_missing() -> None:
    values = {"servo1_raw": 1500, "servo9_raw": 1600, "port": 1}
    short = writer.frame("SERVO_OUTPUT_RAW", values)
    old = writer.frame("SERVO_OUTPUT_RAW", values, version=1)
    full = writer.frame("SERVO_OUTPUT_RAW", values, trim=False)
    assert len(short) < len(full)
    log = TelemetryFile.open(writer.log([(0.0, short), (0.1, old), (0.2, full)]))
    assert log.column("SERVO_OUTPUT_RAW", "servo9_raw").tolist() == [1600, 0, 1600]
    assert log.column("SERVO_OUTPUT_RAW", "servo16_raw").tolist() == [0, 0, 0]


def test_messages_of_a_newer_protocol_are_stepped_over_and_counted() -> None:
    strange = bytearray(writer.frame("HEARTBEAT", {"type": 1}, trim=False))
    strange[7:10] = (9_999_999).to_bytes(3, "little")
    beat = writer.frame("HEARTBEAT", {"type": 2})
    log = TelemetryFile.open(writer.log([(0, bytes(strange)), (1, beat), (2, bytes(strange)), (3, beat)]))
    assert (log.count("HEARTBEAT"), log.unknown, log.lost_bytes) == (2, 2, 0)
    assert [d.kind for d in log.damage] == ["unknown_message"]


# ------------------------------------------------------------------ who and what


def test_systems_components_and_instances_are_kept_apart(flight: Path) -> None:
    log = TelemetryFile.open(flight)
    assert log.sources("HEARTBEAT") == (CRAFT, STATION)
    assert log.count("RC_CHANNELS") == 0
    assert log.column("HEARTBEAT", "type", source=STATION).tolist() == [6] * 20
    assert log.instances("NAMED_VALUE_FLOAT") == ("SRVP1", "SRVP2")
    values = log.column("NAMED_VALUE_FLOAT", "value", instance="SRVP2")
    np.testing.assert_allclose(values, 0.1 * np.arange(1, 200, 2), rtol=1e-6)
    assert log.time_s("NAMED_VALUE_FLOAT", instance="SRVP2").shape == values.shape


def test_channels_have_names_units_and_rising_times(flight: Path) -> None:
    found = channels(TelemetryFile.open(flight))
    servo = found["SERVO_OUTPUT_RAW.servo3_raw"]
    assert (servo.unit, servo.origin) == ("us", "SERVO_OUTPUT_RAW.servo3_raw")
    np.testing.assert_array_equal(servo.values, 1003 + np.arange(200))
    assert found["NAMED_VALUE_FLOAT[SRVP1].value"].values.size == 100
    assert found["DEBUG_FLOAT_ARRAY[7].data[3]"].values[0] == 3.0
    assert "1/1:HEARTBEAT.type" in found
    assert "HEARTBEAT.type" not in found
    assert not any(name.startswith(("PARAM_VALUE", "STATUSTEXT")) for name in found)
    assert all(np.all(np.diff(found[name].time_s) > 0) for name in found)
    with pytest.raises(KeyError):
        found["SERVO_OUTPUT_RAW.servo3"]


def test_a_second_port_has_its_number_in_brackets() -> None:
    frames = [writer.frame("SERVO_OUTPUT_RAW", {"time_usec": 1000, "port": p, "servo1_raw": 1500 + p}) for p in (0, 1)]
    found = channels(TelemetryFile.open(writer.log(enumerate(frames))))
    assert found["SERVO_OUTPUT_RAW.servo1_raw"].values.tolist() == [1500.0]
    assert found["SERVO_OUTPUT_RAW[1].servo1_raw"].values.tolist() == [1501.0]


@pytest.mark.parametrize(
    "other",
    [
        {"type": 6, "autopilot": 0},
        {"type": 18, "autopilot": 3},
        {"type": 0, "autopilot": 0},
        {"type": 5, "autopilot": 3},
    ],
)
def test_heartbeats_beside_the_vehicles_do_not_outvote_it(other: dict[str, int]) -> None:
    copter = writer.frame("HEARTBEAT", {"type": 2, "autopilot": 3})
    entries = [(float(k), copter) for k in range(3)]
    entries += [(0.1 * k, writer.frame("HEARTBEAT", other, source=(255, 190))) for k in range(40)]
    found = TelemetryFile.open(writer.log(sorted(entries))).craft
    assert found is not None
    assert (found.type, found.system) == ("quadrotor", 1)


def test_a_log_behind_a_megabyte_of_zeros_is_read() -> None:
    content = writer.flight(2.0)
    log = logparsers.read(io.BytesIO(bytes(880_000) + content))
    whole = logparsers.read(io.BytesIO(content))
    np.testing.assert_array_equal(log["ATTITUDE.roll"].values, whole["ATTITUDE.roll"].values)
    assert [(damage.kind, damage.count) for damage in log.damage] == [("corrupt", 880_000)]


def test_what_comes_over_two_links_counts_once_and_other_rows_of_one_stamp_stay() -> None:
    def named(value: float) -> bytes:
        return writer.frame("NAMED_VALUE_FLOAT", {"time_boot_ms": 9000, "name": "SRVP1", "value": value})

    log = logparsers.read(io.BytesIO(writer.log([(0.0, named(1.0)), (0.0, named(1.0)), (0.0, named(2.0))])))
    assert log["NAMED_VALUE_FLOAT[SRVP1].value"].values.tolist() == [1.0, 2.0]
    assert [damage.count for damage in log.damage if damage.kind == "out_of_order"] == [1]


def test_the_vehicle_introduces_itself(flight: Path) -> None:
    log = TelemetryFile.open(flight)
    craft = log.craft
    assert craft is not None
    assert (craft.type, craft.autopilot, craft.system) == ("fixed wing", "ardupilotmega", 1)
    assert craft.firmware == "ArduPlane V4.6.0 (abc)"
    assert log.parameters["SERVO3_MIN"] == 1030.0
    assert log.texts[0].severity == 6


def test_long_texts_are_put_together_and_px4_integers_restored() -> None:
    raw = float(np.array([42], dtype=np.int32).view(np.float32)[0])
    entries = [
        (0.0, writer.frame("HEARTBEAT", {"type": 1, "autopilot": 12})),
        (0.1, writer.frame("STATUSTEXT", {"severity": 4, "text": "a" * 50, "id": 5, "chunk_seq": 0})),
        (0.2, writer.frame("STATUSTEXT", {"severity": 4, "text": "tail", "id": 5, "chunk_seq": 1})),
        (
            0.3,
            writer.frame("PARAM_VALUE", {"param_id": "PWM_MAIN_FUNC1", "param_value": raw, "param_type": 6}),
        ),
    ]
    log = TelemetryFile.open(writer.log(entries))
    assert [said.text for said in log.texts] == ["a" * 50 + "tail"]
    assert log.parameters == {"PWM_MAIN_FUNC1": 42.0}
    assert log.changed == ()
    again = {"param_id": "PWM_MAIN_FUNC1", "param_value": 0.0, "param_type": 6}
    (changed,) = TelemetryFile.open(writer.log([*entries, (9.0, writer.frame("PARAM_VALUE", again))])).changed
    assert changed[1:] == ("PWM_MAIN_FUNC1", 42.0, 0.0)


# ------------------------------------------------------------------ time


def test_the_microsecond_counter_runs_on_over_its_overflow() -> None:
    path = writer.flight(60.0, boot_s=4294.967296 - 30.0)
    log = TelemetryFile.open(path)
    assert np.diff(log.column("SERVO_OUTPUT_RAW", "time_usec").astype(np.int64)).min() < 0
    np.testing.assert_allclose(log.time_s("SERVO_OUTPUT_RAW"), log.time_s("ATTITUDE"), atol=2e-3)
    assert log.time_s("SERVO_OUTPUT_RAW")[0] == pytest.approx(4264.967, abs=2e-3)


def test_a_counter_that_overflowed_before_the_log_began_is_set_right() -> None:
    log = TelemetryFile.open(writer.flight(5.0, boot_s=3 * 4294.967296 + 10.0))
    np.testing.assert_allclose(log.time_s("SERVO_OUTPUT_RAW"), log.time_s("ATTITUDE"), atol=2e-3)


def test_milliseconds_run_on_over_49_days() -> None:
    wrap_s = 4_294_967.296
    entries = []
    for k in range(100):
        stamp = round((wrap_s - 5.0 + 0.1 * k) * 1000) % 2**32
        entries.append((0.1 * k, writer.frame("ATTITUDE", {"time_boot_ms": stamp})))
    times = TelemetryFile.open(writer.log(entries)).time_s("ATTITUDE")
    np.testing.assert_allclose(times, wrap_s - 5.0 + 0.1 * np.arange(100), atol=1e-3)


def test_messages_without_a_stamp_use_arrival_on_the_vehicles_clock() -> None:
    log = TelemetryFile.open(writer.flight(120.0))
    late = log.time_s("VFR_HUD") - log.time_s("ATTITUDE")
    assert late.min() >= 0.0
    assert late.max() < 0.03


def test_a_reboot_is_recorded_and_time_runs_on() -> None:
    first = [(0.1 * k, writer.frame("ATTITUDE", {"time_boot_ms": 600_000 + 100 * k})) for k in range(300)]
    second = [(60 + 0.1 * k, writer.frame("ATTITUDE", {"time_boot_ms": 4_000 + 100 * k})) for k in range(300)]
    log = TelemetryFile.open(writer.log(first + second))
    times = log.time_s("ATTITUDE")
    np.testing.assert_allclose(times, 600.0 + np.concatenate([np.arange(300), 600 + np.arange(300)]) * 0.1, atol=1e-3)
    assert [d.kind for d in log.damage] == ["reboot"]
    assert log.damage[0].end_s == pytest.approx(660.0, abs=1e-3)


def test_messages_that_overtake_each_other_are_no_reboot() -> None:
    rng = np.random.default_rng(3)
    sent = np.arange(0, 60, 0.1)
    arrived = sent + np.where(rng.random(sent.size) < 0.05, 2.5, 0.02)
    order = np.argsort(arrived)
    entries: list[tuple[float, bytes]] = []
    for i in order:
        frame = writer.frame("ATTITUDE", {"time_boot_ms": round(5000 + 1000 * sent[i])})
        entries.append((float(arrived[i]), frame))
    log = TelemetryFile.open(writer.log(entries))
    assert not log.damage
    channel = channels(log)["ATTITUDE.roll"]
    np.testing.assert_allclose(channel.time_s, 5.0 + sent, atol=1e-9)
    (late,), _ = channels(log).survey()
    assert (late.kind, late.count) == ("out_of_order", int(np.count_nonzero(np.diff(sent[order]) < 0)))


def test_the_receivers_clock_may_be_set() -> None:
    entries = []
    for k in range(1200):
        jump = 3600.0 if k >= 600 else 0.0
        entries.append((0.1 * k + jump, writer.frame("ATTITUDE", {"time_boot_ms": 5000 + 100 * k})))
        entries.append((0.1 * k + jump + 0.001, writer.frame("VFR_HUD", {"airspeed": k})))
    log = TelemetryFile.open(writer.log(entries))
    assert [d.kind for d in log.damage] == ["arrival_jump"]
    np.testing.assert_allclose(log.time_s("VFR_HUD"), 5.0 + 0.1 * np.arange(1200), atol=0.01)


def test_a_companions_own_clock_is_shifted_onto_the_vehicles() -> None:
    entries = []
    for k in range(600):
        entries.append((0.1 * k, writer.frame("ATTITUDE", {"time_boot_ms": 5000 + 100 * k})))
        unix_us = 1_700_000_000_000_000 + 100_000 * k + 50_000
        vector = writer.frame("DEBUG_VECT", {"time_usec": unix_us, "name": "SURF", "x": k}, source=COMPANION)
        entries.append((0.1 * k + 0.05 + 0.004 * (k % 5), vector))
    log = TelemetryFile.open(writer.log(entries))
    np.testing.assert_allclose(log.time_s("DEBUG_VECT"), 5.05 + 0.1 * np.arange(600), atol=1e-3)
    assert log.damage == ()


def test_a_stamp_of_zero_means_arrival_time() -> None:
    entries = []
    for k in range(100):
        entries.append((0.1 * k, writer.frame("ATTITUDE", {"time_boot_ms": 5000 + 100 * k})))
        fix_us = (5000 + 100 * k) * 1000 if k >= 50 else 0
        entries.append((0.1 * k + 0.001, writer.frame("GPS_RAW_INT", {"time_usec": fix_us})))
    log = TelemetryFile.open(writer.log(entries))
    np.testing.assert_allclose(log.time_s("GPS_RAW_INT"), 5.0 + 0.1 * np.arange(100), atol=2e-3)


def test_a_stream_without_arrival_times_is_read_by_its_own_clock() -> None:
    stamps = range(5000, 25000, 100)
    content = b"".join(
        writer.frame("ATTITUDE", {"time_boot_ms": ms}) + writer.frame("VFR_HUD", {"airspeed": 1}) for ms in stamps
    )
    log = TelemetryFile.open(content)
    np.testing.assert_allclose(log.time_s("ATTITUDE"), np.array(stamps) * 1e-3)
    assert np.all(np.diff(log.time_s("VFR_HUD")) >= 0)
    assert [d.kind for d in log.damage] == ["no_arrival_time"]


def test_commands_and_positions_of_a_real_flight_share_one_clock() -> None:
    path = next((p for p in real_logs(".tlog") if "feedback" in p.name), None)
    if path is None:
        pytest.skip("no flight with measured positions among the real logs")
    found = channels(TelemetryFile.open(path))
    servo, position = found["SERVO_OUTPUT_RAW.servo2_raw"], found["NAMED_VALUE_FLOAT[SRVP2].value"]
    lags = np.arange(-0.3, 0.6, 0.02)
    times = position.time_s[(position.time_s > 60.0) & (position.time_s < 90.0)]
    measured = np.interp(times, position.time_s, position.values)
    fits = [abs(np.corrcoef(measured, np.interp(times - lag, servo.time_s, servo.values))[0, 1]) for lag in lags]
    assert max(fits) > 0.97
    assert 0.0 < lags[int(np.argmax(fits))] < 0.25  # the simulated servo has a time constant of 0.1 to 0.2 s


# ------------------------------------------------------------------ damage


def damaged(content: bytes, kind: str, rng: np.random.Generator) -> bytes:
    at = int(rng.integers(100, len(content) - 2000))
    noise = rng.integers(0, 256, 700, dtype=np.uint8).tobytes()
    fake = bytes((0xFD, 255, 0, 0, 1, 1, 1, 36, 0, 0))
    return {
        "zeros": content[:at] + bytes(512) + content[at + 512 :],
        "inserted": content[:at] + noise + content[at:],
        "removed": content[:at] + content[at + 300 :],
        "fake header": content[:at] + fake + content[at:],
        "overwritten": content[:at] + noise + content[at + 700 :],
        "cut": content[:at],
        "one bit": content[:at] + bytes((content[at] ^ 4,)) + content[at + 1 :],
        "two pieces": content[at:] + content[:at],
    }[kind]


KINDS = ["zeros", "inserted", "removed", "fake header", "overwritten", "cut", "one bit", "two pieces"]


def compare_damaged(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    theirs = Counter(m.get_type() for m in pymavlink_reads(path))
    log = TelemetryFile.open(path)
    for name, count in theirs.items():
        assert log.count(name) >= count, f"{name}: {log.count(name)} of {count}"


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_as_many_good_messages_as_pymavlink_and_the_damage_recorded(tmp_path: Path, kind: str) -> None:
    clean = writer.flight()
    whole = sum(TelemetryFile.open(clean).count(m) for m in TelemetryFile.open(clean).messages)
    for seed in range(5):
        content = damaged(clean, kind, np.random.default_rng(seed))
        compare_damaged(tmp_path / "damaged.tlog", content)
        log = TelemetryFile.open(content)
        good = sum(log.count(m) for m in log.messages)
        kinds = {d.kind for d in log.damage}
        assert good == whole or kinds & {"bad_checksum", "corrupt", "truncated", "unknown_message"} or kind == "cut"
        spans = log.damaged_bytes
        assert np.all(np.diff(spans["offset"]) > 0)
        assert int(spans["length"].sum()) == log.lost_bytes


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_real_logs_damaged_as_well(tmp_path: Path, kind: str) -> None:
    content = real_logs(".tlog")[0].read_bytes()[:200_000]
    compare_damaged(tmp_path / "damaged.tlog", damaged(content, kind, np.random.default_rng(1)))


def test_a_frame_that_lost_its_arrival_time_is_kept() -> None:
    entries = [(0.1 * k, writer.frame("ATTITUDE", {"time_boot_ms": 1000 + 100 * k})) for k in range(50)]
    whole = writer.log(entries)
    where = len(writer.log(entries[:20]))
    log = TelemetryFile.open(whole[: where + 2] + whole[where + 5 :])
    assert log.count("ATTITUDE") == 50
    assert {d.kind for d in log.damage} == {"no_arrival_time", "corrupt"}
    np.testing.assert_allclose(log.time_s("ATTITUDE"), 1.0 + 0.1 * np.arange(50))


def test_a_wild_arrival_time_does_not_spread() -> None:
    entries = [(0.1 * k, writer.frame("ATTITUDE", {"time_boot_ms": 1000 + 100 * k})) for k in range(100)]
    entries += [(10 + 0.1 * k, writer.frame("VFR_HUD", {"airspeed": k})) for k in range(50)]
    content = bytearray(writer.log(entries))
    content[len(writer.log(entries[:120])) + 1] ^= 0x20
    log = TelemetryFile.open(bytes(content))
    np.testing.assert_allclose(log.time_s("VFR_HUD"), 11.0 + 0.1 * np.arange(50), atol=0.11)


# ------------------------------------------------------------------ bad input


def use_everything(content: bytes) -> None:
    try:
        log = TelemetryFile.open(content)
    except LogError:
        return
    found = channels(log)
    for name in found:
        assert np.all(np.diff(found[name].time_s) > 0)
    for name in log.messages:
        for field in log.layout(name).fields:
            log.column(name, field)
    assert log.lost_bytes <= len(content)
    _ = log.vehicle, log.parameters, log.texts, log.damage


@pytest.mark.slow
def test_forged_but_correct_frames_are_survived() -> None:
    rng = np.random.default_rng(21)
    layouts = list(mavlink.dialect().layouts.values())
    for _ in range(15):
        content = b""
        for _ in range(60):
            layout = layouts[int(rng.integers(len(layouts)))]
            values: dict[str, Any] = {}
            for field in layout.fields.values():
                if not field.is_text:
                    raw = rng.choice([0, 0x7F, 0x80, 0xFF, 1], field.width).astype(np.uint8)
                    values[field.name] = raw.view(field.dtype)
            time_us = (0, 1, 2**63, 2**64 - 1, writer.EPOCH_US)[int(rng.integers(5))]
            content += writer.record(time_us, writer.frame(layout.name, values))
        use_everything(content)


@pytest.mark.slow
@pytest.mark.parametrize(
    "pattern", [b"\x00", b"\xff", b"\xfe", b"\xfd", b"\xfe\xff", b"\xfd\x00", b"\xfe\xff\x00\x01\x01\x00"]
)
def test_a_megabyte_of_nonsense_takes_a_bounded_time(pattern: bytes) -> None:
    content = (pattern * (1_000_000 // len(pattern) + 1))[:1_000_000]
    with contextlib.suppress(LogError):
        TelemetryFile.open(content[:1000])  # compiles
    begun = time.process_time()
    with contextlib.suppress(LogError):
        TelemetryFile.open(content)
    assert time.process_time() - begun < 5.0


@pytest.mark.slow
def test_thousands_of_damaged_places_do_not_fill_memory() -> None:
    beat = writer.record(writer.EPOCH_US, writer.frame("HEARTBEAT", {"type": 1}))
    content = (beat + b"\x00") * 20_000
    TelemetryFile.open(content[:1000])
    tracemalloc.start()
    log = TelemetryFile.open(content)
    assert len(log.damage) <= 1002
    assert sum(d.count for d in log.damage if d.kind == "corrupt") == log.lost_bytes == 20_000
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8 * len(content)


def test_empty_and_foreign_files_are_refused(tmp_path: Path) -> None:
    empty = tmp_path / "empty.tlog"
    empty.touch()
    for source in (empty, b""):
        with pytest.raises(EmptyLog):
            TelemetryFile.open(source)
    with pytest.raises(UnreadableLog, match="no MAVLink message"):
        TelemetryFile.open(b"time,command\n1,2\n" * 100)
    with pytest.raises(MissingLog):
        TelemetryFile.open(tmp_path / "missing.tlog")


def test_an_open_file_is_read_from_its_beginning_and_stays_open(flight: Path) -> None:
    with flight.open("rb") as file:
        file.seek(100)
        assert TelemetryFile.open(file).count("ATTITUDE") == 200
        assert not file.closed
    assert TelemetryFile.open(io.BytesIO(flight.read_bytes())).count("ATTITUDE") == 200


@pytest.mark.slow
def test_thousands_of_senders_names_and_restarts_take_a_bounded_time() -> None:
    """Each of these took time with the square of the length of the file."""
    rows = 2_000
    stamps = np.random.default_rng(0).integers(0, 2**32, rows).tolist()
    value = {"name": "A", "value": 1.0}
    floods = (
        writer.log(
            (k * 0.01, writer.frame("NAMED_VALUE_FLOAT", value, source=(k % 250, k // 250))) for k in range(rows)
        ),
        writer.log((k * 0.01, writer.frame("NAMED_VALUE_FLOAT", {"name": f"N{k}", "value": 1.0})) for k in range(rows)),
        writer.log((k * 0.01, writer.frame("ATTITUDE", {"time_boot_ms": stamp})) for k, stamp in enumerate(stamps)),
    )
    for content in floods:
        logparsers.read(io.BytesIO(content[:1000]))  # compiles
        begun = time.process_time()
        log = logparsers.read(io.BytesIO(content))
        assert time.process_time() - begun < 20e-6 * len(content)
        assert len(log.damage) <= 300


def test_the_date_is_what_the_autopilot_says_most_of_the_time() -> None:
    """A receiver without a fix says 1970 or another year; where nobody knows, the ground station's clock counts."""
    boot = datetime(2024, 5, 1, 9, 0, tzinfo=UTC)
    boot_us = round(boot.timestamp() * 1e6)
    entries = []
    for k in range(20):
        unix_us = 0 if k < 3 else boot_us + 1_000_000 * k + (400 * 86_400_000_000 if k == 5 else 0)
        told = {"time_unix_usec": unix_us, "time_boot_ms": 1000 * k}
        entries += [(k + 0.02, writer.frame("SYSTEM_TIME", told, sequence=2 * k))]
        entries += [(k + 0.02, writer.frame("ATTITUDE", {"time_boot_ms": 1000 * k, "roll": 0.1}, sequence=2 * k + 1))]
    start = logparsers.read(io.BytesIO(writer.log(entries))).start_utc
    assert start is not None
    assert abs((start - boot).total_seconds()) < 0.1
    alone = logparsers.read(io.BytesIO(writer.log(entries[1::2]))).start_utc
    assert alone is not None
    assert abs(alone.timestamp() - 1e-6 * writer.EPOCH_US) < 0.1


def test_two_senders_of_one_message_keep_their_own_clocks() -> None:
    """The second was booted 40 s later; both rows are where they belong on the common time axis."""
    entries = []
    for k in range(50):
        for source, boot_s in (((1, 1), 100.0), ((1, 2), 60.0)):
            attitude = {"time_boot_ms": round(1000 * (boot_s + 0.1 * k)), "roll": float(source[1])}
            entries.append((0.1 * k + 0.01, writer.frame("ATTITUDE", attitude, source=source, sequence=k)))
    time_s = TelemetryClock(TelemetryFile.open(writer.log(entries)), bare=False).time_s("ATTITUDE", None)
    assert time_s.shape == (100,)
    np.testing.assert_allclose(time_s[::2], time_s[1::2], atol=0.02)
    np.testing.assert_allclose(np.diff(time_s[::2]), 0.1, atol=1e-3)


def test_severities_are_those_of_pymavlink() -> None:
    known = vars(importlib.import_module("pymavlink.dialects.v20.all"))
    assert {one.name: known[f"MAV_SEVERITY_{one.name}"] for one in protocol.Severity} == {
        one.name: one.value for one in protocol.Severity
    }


def test_numbers_of_mavlink_have_its_names() -> None:
    assert (protocol.Autopilot.PX4, protocol.Component.AUTOPILOT1, protocol.State.CRITICAL) == (12, 1, 5)
    with pytest.raises(AttributeError):
        protocol.Anything  # noqa: B018 - asking is the test
