"""PX4 logs: what pyulog reads, bounded and honest about damage."""

from __future__ import annotations

import contextlib
import io
import struct
import time
import tracemalloc
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import numpy as np
import pytest
from pyulog import ULog

import logparsers
from logparsers.channels import LazyChannels
from logparsers.errors import EmptyLog, LogError, MissingChannel, MissingLog, UnreadableLog
from logparsers.ulog import UlogFile
from logparsers.ulog.encode import Topic, encode
from tests.parsers import ulog_writer as writer
from tests.parsers.external import real_logs

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    from logparsers.records import FlightLog


def channels(log: UlogFile) -> LazyChannels:
    return LazyChannels(log)


def test_every_value_of_real_logs_equals_pyulogs() -> None:
    for path in real_logs(".ulg"):
        theirs = ULog(str(path))
        log = UlogFile.open(path, only=None)
        assert set(log.topics) == {(d.name, d.multi_id) for d in theirs.data_list}
        for found in theirs.data_list:
            for field, values in found.data.items():
                ours = log.column(found.name, field, instance=found.multi_id)
                assert ours.dtype == values.dtype
                assert ours.tobytes() == values.tobytes()
        assert dict(log.parameters) == {k: float(v) for k, v in theirs.initial_parameters.items()}
        assert len(log.texts) == len(theirs.logged_messages)
        assert [d.kind for d in log.damage] == ["gap"] * len(theirs.dropouts)


def test_a_generated_log_is_read_back() -> None:
    log = UlogFile.open(writer.flight())
    found = channels(log)
    servo = found["actuator_servos[0].control[3]"]
    np.testing.assert_allclose(servo.values, 0.03 * np.arange(40), rtol=1e-6)
    np.testing.assert_allclose(servo.time_s, 1.0 + 0.02 * np.arange(40))
    assert found["actuator_outputs[1].output[0]"].values[0] == 1000.0
    assert servo.origin == "actuator_servos.control[3]"
    assert log.parameters == {"MAV_TYPE": 1.0, "TRIM": 0.75}
    ((time_s, name, before, value),) = log.changed
    assert (name, before, value) == ("TRIM", 0.5, 0.75)
    assert 1.0 + 0.02 * 19 <= time_s <= 1.0 + 0.02 * 21
    assert log.vehicle == "fixed wing"
    assert log.firmware == "PX4 1.15.1"
    assert [(said.severity, said.text) for said in log.texts] == [(4, "[commander] low battery")]
    assert not any("_padding" in name for name in found)


@pytest.mark.parametrize("cut", [0, 1, 7, 100, 1000])
def test_a_log_that_is_cut_gives_what_pyulog_reads(cut: int) -> None:
    content = writer.flight(200)
    content = content[: len(content) - cut]
    theirs, log = ULog(io.BytesIO(content)), UlogFile.open(content)
    assert set(log.topics) == {(found.name, found.multi_id) for found in theirs.data_list}
    for found in theirs.data_list:
        for field, values in found.data.items():
            assert log.column(found.name, field, instance=found.multi_id).tobytes() == values.tobytes()
    ((time_us, name, value),) = theirs.changed_parameters
    assert [(one.time_s, one.name, one.value) for one in log.changed] == [(time_us * 1e-6, name, value)]
    (gap, *cuts) = log.damage
    assert gap.start_s == theirs.dropouts[0].timestamp * 1e-6
    assert [defect.kind for defect in cuts] == ["truncated"] * (cut > 0)


@pytest.mark.parametrize(
    "change",
    [
        lambda log: log + writer.subscribe(3, "debug_array", 1),
        lambda log: log + writer.data(99, bytes(40)),
        lambda log: log + writer.data(4, b"\xff" * 12),
    ],
)
def test_messages_that_contradict_each_other_cost_the_others_nothing(change: Callable[[bytes], bytes]) -> None:
    assert UlogFile.open(change(writer.flight(50))).count("actuator_servos") == 50


def test_samples_of_a_wrong_length_are_damage() -> None:
    log = writer.flight(50) + writer.data(0, bytes(30))
    file = UlogFile.open(log)
    assert file.count("actuator_servos") == 50
    assert [defect.kind for defect in file.damage][-1] == "corrupt"


def test_senders_that_share_a_topic_are_told_apart_by_name() -> None:
    found = channels(UlogFile.open(writer.flight()))
    np.testing.assert_array_equal(found["debug_array[0][SRVP].data[2]"].values, 2.0 + np.arange(0, 40, 2))
    assert found["debug_array[0][RIG].data[0]"].values.size == 20
    assert "debug_array[0].data[0]" not in found


def test_only_the_topics_asked_for_are_read() -> None:
    assert ("sensor_baro", 0) not in UlogFile.open(
        writer.flight(), only=("actuator_*", "debug_*", "vehicle_status")
    ).topics
    log = UlogFile.open(writer.flight(), only=("sensor_*",))
    assert log.topics == (("sensor_baro", 0),)
    with pytest.raises(MissingChannel, match="pressure"):
        log.column("sensor_baro", "altitude")


def test_leaving_topics_out_changes_nothing_else() -> None:
    for path in real_logs(".ulg"):
        few, every = UlogFile.open(path, only=("actuator_*", "debug_*", "vehicle_status")), UlogFile.open(path)
        assert 0 < len(few.topics) < len(every.topics)
        assert few.parameters == every.parameters
        assert few.texts == every.texts
        for topic, instance in few.topics:
            for field in few.fields(topic, instance):
                ours = few.column(topic, field, instance=instance)
                assert ours.tobytes() == every.column(topic, field, instance=instance).tobytes()


def test_damage_far_from_a_topic_costs_it_nothing() -> None:
    content = bytearray(writer.flight(200))
    start = content.index(b"D\x03\x00", len(content) // 2) - 2
    content[start : start + 50] = bytes(50)
    theirs = ULog(io.BytesIO(bytes(content)), message_name_filter_list=["actuator_servos"])
    log = UlogFile.open(bytes(content))
    assert log.count("actuator_servos") == len(theirs.get_dataset("actuator_servos").data["timestamp"])
    assert "corrupt" in {d.kind for d in log.damage}


def test_dropouts_and_a_cut_end_are_damage() -> None:
    whole = writer.flight()
    assert [d.kind for d in UlogFile.open(whole).damage] == ["gap"]
    gap = UlogFile.open(whole).damage[0]
    assert gap.end_s is not None
    assert gap.start_s is not None
    assert gap.end_s - gap.start_s == pytest.approx(0.03)
    assert [d.kind for d in UlogFile.open(whole[:-5]).damage] == ["gap", "truncated"]


def test_a_path_gives_what_bytes_give(tmp_path: Path) -> None:
    path = tmp_path / "flight.ulg"
    path.write_bytes(writer.flight())
    from_path, from_bytes = channels(UlogFile.open(path)), channels(UlogFile.open(writer.flight()))
    assert list(from_path) == list(from_bytes)
    for name in from_path:
        np.testing.assert_array_equal(from_path[name].values, from_bytes[name].values)


def test_damage_prints_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    content = bytearray(writer.flight())
    start = content.index(b"D\x00\x00")
    content[start + 200 : start + 260] = bytes(range(60))
    damage = UlogFile.open(bytes(content)).damage
    assert "corrupt" in {d.kind for d in damage}
    assert capfd.readouterr() == ("", "")


def test_empty_and_foreign_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError):
        UlogFile.open(b"")
    for content in (b"ULog", b"time,command\n1,2\n" * 10):
        with pytest.raises(UnreadableLog):
            UlogFile.open(content)
    with pytest.raises(EmptyLog):
        UlogFile.open(writer.header())
    with pytest.raises(MissingLog):
        UlogFile.open(tmp_path / "missing.ulg")


BOMBS = {
    "wide": ["a:uint64_t timestamp;b[60000] x;", "b:c[60000] x;", "c:uint8_t[60000] x;"],
    "many wide fields": ["a:uint64_t timestamp;" + "".join(f"uint8_t[65000] x{i};" for i in range(500))],
    "endless": ["a:uint64_t timestamp;a x;"],
    "mutual": ["a:uint64_t timestamp;b x;", "b:a y;"],
}


@pytest.mark.parametrize("bomb", [pytest.param("wide", marks=pytest.mark.slow), *list(BOMBS)[1:]])
def test_forged_formats_do_not_fill_memory(bomb: str) -> None:
    content = writer.header() + b"".join(writer.message("F", text.encode()) for text in BOMBS[bomb])
    content += b"".join(writer.subscribe(k, "a", k % 4) for k in range(200))
    content += writer.data(0, struct.pack("<Q", 1) + bytes(100))
    tracemalloc.start()
    begun = time.process_time()
    with contextlib.suppress(LogError):
        UlogFile.open(content)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200e6
    assert time.process_time() - begun < 10.0


@pytest.mark.parametrize("filling", [b"\x00", b"\xff", b"\x00\x00D", b"\xff\xffZ", b"\x05\x00D\x00\x00"])
@pytest.mark.parametrize("where", ["definitions", "data"])
def test_nonsense_takes_a_bounded_time(filling: bytes, where: str) -> None:
    start = writer.header() if where == "definitions" else writer.flight(5)
    content = start + (filling * 300_000)[:300_000]
    begun = time.process_time()
    with contextlib.suppress(LogError):
        channels(UlogFile.open(content))
    assert time.process_time() - begun < 10.0


def test_the_date_is_that_of_the_first_fix() -> None:
    boot = datetime(2024, 5, 1, 9, 0, tzinfo=UTC)
    gps = "vehicle_gps_position:uint64_t timestamp;uint64_t time_utc_usec;"
    out = [writer.subscribe(9, "vehicle_gps_position")]
    for k in range(5):
        stamp_us = 1_000_000 * (k + 1)
        utc_us = round(boot.timestamp() * 1e6) + stamp_us if k > 1 else 0
        out.append(writer.data(9, struct.pack("<QQ", stamp_us, utc_us)))
    head = writer.header()
    content = head + writer.message("F", gps.encode()) + writer.flight(20).removeprefix(head)
    assert logparsers.read(io.BytesIO(content)).start_utc is None
    assert logparsers.read(io.BytesIO(content + b"".join(out))).start_utc == boot
    without = (content + b"".join(out)).replace(b"position:uint64_t timestamp", b"position:uint64_t othername")
    assert logparsers.read(io.BytesIO(without)).start_utc is None


def test_topics_published_before_the_log_began_do_not_make_it_longer() -> None:
    stamps = np.arange(100_000_000, 104_000_000, 20_000).astype(np.uint64)
    servos = Topic("actuator_servos", {"timestamp": stamps, "control": np.zeros((stamps.size, 8), np.float32)})
    content = encode([servos])
    latched = Topic("home_position", {"timestamp": np.array([3_000_000], np.uint64), "alt": np.zeros(1, np.float32)})
    both = encode([latched, servos])
    both = both[:8] + content[8:16] + both[16:]  # the head tells when logging began
    log = logparsers.read(io.BytesIO(both))
    assert log["home_position[0].alt"].time_s.tolist() == [3.0]
    assert log.duration_s == pytest.approx(3.98)


def test_a_topic_published_once_long_after_the_flight_does_not_make_it_longer() -> None:
    stamps = np.arange(1_000_000, 5_000_000, 20_000).astype(np.uint64)
    servos = Topic("actuator_servos", {"timestamp": stamps, "control": np.zeros((stamps.size, 8), np.float32)})
    once = Topic("mission", {"timestamp": np.array([1_200_000_000], np.uint64), "count": np.zeros(1, np.float32)})
    log = logparsers.read(io.BytesIO(encode([servos, once])))
    assert log["mission[0].count"].time_s.tolist() == [1200.0]
    assert log.duration_s == pytest.approx(3.98)


def test_what_nobody_had_published_when_the_log_began_is_no_damage() -> None:
    """PX4 logs each topic once at the beginning, with a stamp of 0 where nobody had published it."""
    stamps = np.arange(100_000_000, 104_000_000, 20_000).astype(np.uint64)
    begun = encode([Topic("actuator_servos", {"timestamp": stamps})])[8:16]

    def read(first: NDArray[np.uint64], servos: NDArray[np.uint64]) -> FlightLog:
        topics = [
            Topic("transponder_report", {"timestamp": first, "altitude": np.ones(first.size, np.float32)}),
            Topic("actuator_servos", {"timestamp": servos, "control": np.zeros((servos.size, 8), np.float32)}),
        ]
        content = encode(topics)
        return logparsers.read(io.BytesIO(content[:8] + begun + content[16:]))

    never = np.zeros(1, np.uint64)
    log = read(never, np.concatenate([never, stamps]))
    assert log.damage == ()
    assert log["actuator_servos[0].control[0]"].time_s[0] == 100.0
    assert [(one.kind, one.count) for one in read(np.zeros(9, np.uint64), stamps).damage] == [("out_of_order", 8)]
