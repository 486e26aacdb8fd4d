"""The DataFlash reader: what pymavlink reads, it reads, bit for bit; and more where the file is damaged."""

from __future__ import annotations

import array
import contextlib
import io
import itertools
import math
import random
import struct
import time
from collections import Counter, defaultdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from pymavlink import DFReader

import logparsers
from logparsers.channels import LazyChannels
from logparsers.dataflash import DataFlashFile, open_dataflash
from logparsers.dataflash.binary import BinaryFile
from logparsers.dataflash.encode import Message, encode
from logparsers.errors import EmptyLog, LogError, MissingLog, UnreadableLog
from servofd.feedback.draft import what_to_log
from tests.fuzz.mutate import mutated
from tests.parsers import dataflash_writer
from tests.parsers.dataflash_writer import SEED, as_text, before_stamps, servo_flight
from tests.parsers.external import real_logs

if TYPE_CHECKING:
    from collections.abc import Iterator

REAL_LOGS = (
    "ardupilot_copter_2015.bin",
    "ardupilot_no_gps.bin",
    "ardupilot_plane_1s.bin",
    "ardupilot_sitl_feedback.bin",
)


def real(name: str) -> Path:
    return next(path for path in real_logs(".bin") if path.name == name)


def pymavlink_rows(path: Path) -> Iterator[Any]:
    with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
        reader = DFReader.DFReader_binary(str(path))
        while (row := reader.recv_msg()) is not None:
            yield row
        reader.close()


def pymavlink_counts(path: Path) -> Counter[str]:
    return Counter(row.get_type() for row in pymavlink_rows(path))


def same_value(ours: Any, theirs: Any) -> bool:
    if isinstance(theirs, bytes):
        return bool(ours.tobytes() == theirs)
    if isinstance(theirs, array.array):
        return bool(ours.tolist() == theirs.tolist())
    if isinstance(theirs, str):
        return str(ours) == theirs
    mine = ours.item()
    return bool(mine == theirs or (math.isnan(mine) and math.isnan(theirs)))


def assert_equal_to_pymavlink(path: Path) -> None:
    log = open_dataflash(path)
    theirs: dict[tuple[str, str], list[Any]] = defaultdict(list)
    seen: Counter[str] = Counter()
    for row in pymavlink_rows(path):
        name = row.get_type()
        seen[name] += 1
        for field in row.get_fieldnames():
            theirs[name, field].append(getattr(row, field))
    assert {n: log.count(n) for n in log.names} == seen
    for (name, field), values in theirs.items():
        ours = log.table(name)[field]
        assert len(ours) == len(values), (name, field)
        if isinstance(values[0], int | float):
            assert np.array_equal(ours, np.array(values), equal_nan=True), (name, field)
        else:
            assert all(map(same_value, ours, values)), (name, field)


def channels(log: DataFlashFile) -> LazyChannels:
    return LazyChannels(log)


def use_up(log: DataFlashFile) -> None:
    """Ask for everything a log has."""
    for name in log.names:
        log.table(name)
    everything = channels(log)
    for name in list(everything)[:40]:
        assert (np.diff(everything[name].time_s) > 0).all()
    assert isinstance(log.damage, tuple)
    assert log.parameters is not None
    assert log.texts is not None
    assert log.start_utc is None or log.start_utc.year > 1900


# -- sound logs -------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("most_bytes", [300_000, pytest.param(None, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("name", REAL_LOGS)
def test_every_value_of_a_real_log_equals_pymavlinks(name: str, most_bytes: int | None, tmp_path: Path) -> None:
    path = tmp_path / "real.bin"
    path.write_bytes(real(name).read_bytes()[:most_bytes])
    assert_equal_to_pymavlink(path)


def test_every_value_of_a_made_log_equals_pymavlinks(tmp_path: Path) -> None:
    path = tmp_path / "made.bin"
    path.write_bytes(encode(servo_flight()))
    assert_equal_to_pymavlink(path)
    assert open_dataflash(path).damage == ()


def test_what_was_encoded_is_what_is_read() -> None:
    messages = servo_flight()
    log = open_dataflash(encode(messages))
    for message in messages:
        order = np.argsort(np.asarray(message.columns["TimeUS"]), kind="stable")
        for field, values in message.columns.items():
            written = np.asarray(values)[order]
            read = log.column(message.name, field)
            if written.dtype.kind == "f":
                assert np.allclose(read, written, rtol=1e-6, equal_nan=True)
            else:
                assert (read == written).all(), (message.name, field)


@pytest.mark.slow
def test_strides_take_the_records_that_a_walk_takes_one_by_one_however_damaged() -> None:
    rng = random.Random(SEED)  # noqa: S311 - a seed, not a secret
    sound = encode(servo_flight(20))
    for _ in range(30):
        data = memoryview(mutated(rng, sound))
        plain, strode = BinaryFile("log", data, strides=False), BinaryFile("log", data)
        assert plain.stretches == strode.stretches
        assert plain.clock.steps == strode.clock.steps
        assert plain.layouts == strode.layouts
        for name in plain.layouts:
            assert (plain.offsets(name) == strode.offsets(name)).all()
            assert (plain.suspect(name) == strode.suspect(name)).all()


def test_units_come_from_the_log() -> None:
    fields = open_dataflash(encode(servo_flight())).layouts
    assert {f.name: f.unit for f in fields["CSRV"].fields.values()} == {
        "TimeUS": "us", "Id": "", "Pos": "deg", "PosCmd": "deg", "V": "V",
    }  # fmt: skip
    assert fields["RCOU"].fields["C1"].unit == "us"
    assert fields["SCAL"].fields["L"].unit == ""  # no FMTU row for it


def test_servo_positions_without_a_unit_are_radians() -> None:
    """ArduPilot up to 4.6 logs DroneCAN's radians; from 4.7 on degrees, and says so."""
    log = open_dataflash(encode(servo_flight(radians=True)))
    assert log.layouts["CSRV"].fields["Pos"].unit == "rad"
    assert channels(log)["CSRV[0].Pos"].unit == "rad"


def test_instances_are_told_apart() -> None:
    log = open_dataflash(encode(servo_flight()))
    assert log.instances("CSRV") == (0, 1, 8)
    assert log.instances("RCOU") == ()
    whole, ids = log.column("CSRV", "Pos"), log.column("CSRV", "Id")
    assert (log.column("CSRV", "Pos", instance=8) == whole[ids == 8]).all()
    assert (log.times_us("CSRV", 8) == log.times_us("CSRV")[ids == 8]).all()


def test_channels_are_named_after_message_instance_and_field() -> None:
    log = open_dataflash(encode(servo_flight()))
    known = channels(log)
    assert {"RCOU.C1", "CSRV[0].Pos", "CSRV[8].V", "SCAL.L"} <= set(known)
    assert not {"PARM.Value", "TXT.N", "ODD.Data", "RCOU.TimeUS", "CSRV.Pos", "CSRV[0].Id"} & set(known)
    channel = known["RCOU.C1"]
    assert (channel.unit, channel.origin) == ("us", "RCOU.C1")
    assert channel.values[:3].tolist() == [1500.0, 1501.0, 1502.0]
    assert channel.time_s[:2].tolist() == [5.00002, 5.04002]
    for wrong in ("RCOU", "RCOU.C9", "RCOU[0].C1", "CSRV.Pos", "CSRV[3].Pos", "NONE.X", "TXT.N", ""):
        assert wrong not in known
        with pytest.raises(KeyError):
            known[wrong]


def test_parameters_texts_and_firmware() -> None:
    log = open_dataflash(encode(servo_flight()))
    assert dict(log.parameters) == {"SERVO1_FUNCTION": 4.0, "SERVO1_TRIM": 1512.0}
    assert (log.firmware, log.vehicle) == ("ArduPlane V4.5.1 (1a2b3c4d)", "fixed wing")
    assert log.texts[1].text == "Throttle armed"
    assert log.changed == ((7.0, "SERVO1_TRIM", 1500.0, 1512.0),)


def test_a_parameter_that_was_set_in_flight_is_said_with_its_time() -> None:
    rows: dict[str, Any] = {"TimeUS": [1_000_000, 1_000_000, 90_000_000], "Value": [4.0, 1.0, 19.0]}
    rows = rows | {"Name": ["SERVO1_FUNCTION", "TRIM", "SERVO1_FUNCTION"]}
    parm = Message("PARM", "QfN", rows, "s--", "F--")
    log = open_dataflash(encode([parm]))
    assert log.changed == ((90.0, "SERVO1_FUNCTION", 4.0, 19.0),)
    assert log.parameters["SERVO1_FUNCTION"] == 19.0


def test_gps_tells_when_the_vehicle_was_booted() -> None:
    log = open_dataflash(encode(servo_flight()))
    assert log.start_utc is not None
    assert log.start_utc.isoformat() == "2024-02-03T23:59:37.999970+00:00"  # week 2300 + 1 s - 18 s - 5.00003 s


def test_a_real_arduplane_log_tells_its_story() -> None:
    log = open_dataflash(real("ardupilot_sitl_feedback.bin"))
    assert log.vehicle == "fixed wing"
    assert log.instances("CSRV") == (0, 1, 3, 8, 9, 11)
    assert log.layouts["CSRV"].fields["Pos"].unit == "deg"
    assert log.parameters["SERVO1_FUNCTION"] == 4.0
    assert log.damage == ()


def test_a_message_that_was_never_logged_has_no_rows() -> None:
    assert open_dataflash(encode(servo_flight())).count("RCUO") == 0


def test_columns_outlive_the_file_and_are_not_views(tmp_path: Path) -> None:
    path = tmp_path / "made.bin"
    path.write_bytes(encode(servo_flight()))
    log = open_dataflash(path)
    column = log.column("RCOU", "C1")
    column[:] = 0
    assert log.column("RCOU", "C1")[0] == 1500


# -- clocks -----------------------------------------------------------------------------------------------


def test_a_log_of_an_old_firmware_counts_milliseconds() -> None:
    old = Message("RCOU", "IH", {"TimeMS": [1000, 1020, 1040, 1060, 1080], "Ch1": [1500] * 5})
    log = open_dataflash(encode([old]))
    assert log.times_us("RCOU").tolist() == [1_000_000, 1_020_000, 1_040_000, 1_060_000, 1_080_000]
    assert log.times_s("RCOU")[1] == 1.02


@pytest.mark.parametrize(("gps", "how"), [("Time", "between those of GPS"), ("Hour", "as if ATT came at 10 Hz")])
def test_rows_of_a_log_without_stamps_are_spread_and_that_is_told(gps: str, how: str) -> None:
    log = logparsers.read(io.BytesIO(before_stamps(100, gps=gps)))
    assert {"ATT.Roll", "CTUN.ThrIn", "GPS.NSats"} <= set(log.channels)
    roll, throttle = log["ATT.Roll"], log["CTUN.ThrIn"]
    np.testing.assert_array_equal(roll.values, np.arange(100) % 90 + 0.25)
    np.testing.assert_array_equal(throttle.values, np.arange(100))
    np.testing.assert_allclose(roll.time_s - roll.time_s[0], 0.1 * np.arange(100), atol=0.06)
    assert np.all((throttle.time_s - roll.time_s > 0.03) & (throttle.time_s - roll.time_s < 0.06))
    assert 9.8 < log.duration_s < 10.1
    (damage,) = log.damage
    assert how in damage.note


def test_a_wild_stamp_of_gps_moves_no_other_row() -> None:
    content = before_stamps(100)
    sound = logparsers.read(io.BytesIO(content))["ATT.Roll"].time_s
    for wild in (b"4123403000", b"3000"):
        log = logparsers.read(io.BytesIO(content.replace(b"123403000", wild)))
        np.testing.assert_allclose(log["ATT.Roll"].time_s, sound, atol=0.02)


def test_a_log_without_stamps_in_which_gps_counts_from_boot() -> None:
    lines = before_stamps(100).splitlines()
    lines = [line.replace(b"NSats,Alt", b"NSats,Alt,T").replace(b"BIHBe", b"BIHBeI") for line in lines]
    first, stamped = 0, []
    for line in lines:
        is_gps = line.startswith(b"GPS, ")
        stamped.append(line + b", %d" % (7000 + first) if is_gps else line)
        first += 1000 * is_gps
    log = logparsers.read(io.BytesIO(b"\n".join(stamped)))
    assert log["GPS.NSats"].time_s.tolist() == [7.0 + k for k in range(10)]
    np.testing.assert_allclose(log["ATT.Roll"].time_s, 7.0 + 0.1 * np.arange(100), atol=0.06)


def test_a_silence_is_reported_as_a_gap() -> None:
    ticks = np.arange(200) * 20_000
    ticks[100:] += 3_000_000
    log = open_dataflash(encode([Message("RCOU", "QH", {"TimeUS": ticks, "C1": ticks % 1000})]))
    (gap,) = log.damage
    assert (gap.kind, gap.start_s, gap.end_s) == ("gap", 1.98, 5.0)


def test_a_reboot_is_reported_and_time_goes_on() -> None:
    first = encode(servo_flight(first_us=60_000_000))
    log = open_dataflash(first + encode(servo_flight(first_us=5_000_000)))
    jumps = [d for d in log.damage if d.kind == "reboot"]
    assert len(jumps) == 1
    assert "to 5.000 s" in jumps[0].note
    assert jumps[0].end_s == pytest.approx(log.times_s("RCOU")[100], abs=0.1)
    assert log.times_us("RCOU")[100] == 5_000_020
    times = log.times_s("RCOU")
    assert (np.diff(times) > 0).all()
    assert times[100] - times[99] == pytest.approx(1.0, abs=0.1)
    assert channels(log)["RCOU.C1"].values.size == 200


def test_one_wrong_time_stamp_is_not_believed() -> None:
    content = bytearray(encode(servo_flight()))
    at = int(BinaryFile("log", memoryview(bytes(content))).offsets("RCOU")[50])
    content[at + 7] ^= 0x40  # ahead by 2**38 us: three days
    log = open_dataflash(bytes(content))
    assert log.damage == ()
    assert np.flatnonzero(log.suspect("RCOU")).tolist() == [50]
    assert channels(log)["RCOU.C1"].values.size == 99
    (lost,), _ = channels(log).survey()
    assert (lost.kind, lost.count) == ("out_of_order", 1)
    assert lost.note == "RCOU: 1 row left out that came twice or with a wrong stamp"


def test_messages_of_one_stamp_are_all_there_and_a_sound_log_is_not_damaged() -> None:
    """The sixteen items of a mission are logged within one microsecond."""
    items = Message(
        "CMD", "QHHf", {"TimeUS": [7_000_000] * 16, "CTot": [16] * 16, "CNum": range(16), "Prm1": [0.5] * 16}
    )
    log = logparsers.read(io.BytesIO(encode([*servo_flight(), items])))
    assert log["CMD.CNum"].values.tolist() == list(range(16))
    np.testing.assert_allclose(log["CMD.CNum"].time_s, 7.0, rtol=0.0, atol=1e-6)
    assert log.damage == ()


@pytest.mark.parametrize(
    ("firmware", "frame", "vehicle"),
    [
        ("ArduPlane V4.5.1", {"Q_ENABLE": 1.0}, "QuadPlane"),
        ("ArduPlane V4.5.1", {"Q_ENABLE": 0.0}, "fixed wing"),
        ("ArduCopter V4.5.1", {"FRAME_CLASS": 6.0}, "helicopter"),
        ("ArduSub V4.1.0", {}, "submarine"),
    ],
)
def test_the_firmware_and_its_settings_tell_the_kind_of_vehicle(
    firmware: str, frame: dict[str, float], vehicle: str
) -> None:
    first_us = 5_000_000
    said = Message("MSG", "QZ", {"TimeUS": [first_us], "Message": [firmware]})
    pulses: dict[str, Any] = {"TimeUS": first_us + 20_000 * np.arange(50), "C1": [1500] * 50}
    parm: dict[str, Any] = {"TimeUS": [first_us] * len(frame), "Name": list(frame), "Value": list(frame.values())}
    log = logparsers.read(io.BytesIO(encode([said, Message("RCOU", "QH", pulses), Message("PARM", "QNf", parm)])))
    assert log.vehicle == vehicle
    assert ("servo" in what_to_log(log)) == (vehicle in ("fixed wing", "QuadPlane"))


def test_the_first_lines_of_an_old_text_log_name_its_firmware() -> None:
    content = b"4\n\nArduCopter V3.0.1 (5c6503e2)\nFree RAM: 1331\nAPM 2\n" + dataflash_writer.before_stamps(100)
    log = logparsers.read(io.BytesIO(content))
    assert (log.firmware, log.vehicle) == ("ArduCopter V3.0.1 (5c6503e2)", "multirotor")
    assert [damage.kind for damage in log.damage] == ["bad_format"]
    assert "has no control surfaces: its outputs turn motors" in what_to_log(log)


# -- damaged logs -----------------------------------------------------------------------------------------


def damaged(sound: bytes, kind: str, at: int, rng: np.random.Generator) -> tuple[bytes, int, int, int]:
    """Return the damaged log, the bytes [lost_from, lost_to) of the sound one, and the shift behind them."""
    if kind == "zeros":
        return sound[:at] + bytes(512) + sound[at + 512 :], at, at + 512, 0
    if kind == "inserted":
        return sound[:at] + rng.bytes(700) + sound[at:], at, at, 700
    if kind == "removed":
        return sound[:at] + sound[at + 300 :], at, at + 300, -300
    if kind == "fake_header":
        return sound[:at] + b"\xa3\x95\x84" + sound[at:], at, at, 3
    if kind == "fake_record":
        return sound[:at] + b"\xa3\x95\x84" + rng.bytes(9) + sound[at:], at, at, 12
    return sound[:at], at, len(sound), 0


KINDS = ("zeros", "inserted", "removed", "fake_header", "fake_record", "truncated")


def untouched(store: BinaryFile, lost_from: int, lost_to: int, shift: int) -> dict[str, set[int]]:
    """Where the records that the damage did not touch are now."""
    kept = {}
    for name, layout in store.layouts.items():
        offsets = store.offsets(name).astype(np.int64)
        before, behind = offsets[offsets + layout.length <= lost_from], offsets[offsets >= lost_to]
        kept[name] = {*before.tolist(), *(behind + shift).tolist()}
    return kept


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_every_record_the_damage_did_not_touch_is_recovered(kind: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(SEED)
    sound = encode(servo_flight(4))
    store = BinaryFile("log", memoryview(sound))
    first = int(store.offsets("RCOU")[5])
    path = tmp_path / "damaged.bin"
    for _ in range(25):
        at = int(rng.integers(first, len(sound) - 1000))
        bad, lost_from, lost_to, shift = damaged(sound, kind, at, rng)
        found = BinaryFile("log", memoryview(bad))
        for name, offsets in untouched(store, lost_from, lost_to, shift).items():
            missing = offsets - set(found.offsets(name).tolist())
            assert not missing, (kind, at, name, missing)
        path.write_bytes(bad)
        ours = sum(found.count(n) for n in found.layouts)
        assert ours >= pymavlink_counts(path).total(), (kind, at)


def test_where_blocks_are_lost_no_record_hides_the_beginning_of_another() -> None:
    """A memory card that loses blocks joins half a record to the rest of another one; pymavlink decodes them."""
    rng = np.random.default_rng(SEED)
    sound = encode(servo_flight(10))
    store = BinaryFile("log", memoryview(sound))
    first = int(store.offsets("RCOU")[5])
    lost = np.sort(rng.choice(np.arange(first, len(sound) - 600, 600), 20, replace=False))
    kept = np.ones(len(sound), np.bool_)
    for at in lost.tolist():
        kept[at : at + 512] = False
    place = np.cumsum(kept) - 1  # where each byte that is left is now
    bad = np.frombuffer(sound, np.uint8)[kept].tobytes()
    found = BinaryFile("log", memoryview(bad))
    spans: list[tuple[int, int]] = []
    for name, layout in store.layouts.items():
        offsets = store.offsets(name).astype(np.int64)
        whole = {int(place[at]) for at in offsets.tolist() if kept[at : at + layout.length].all()}
        read = {int(at) for at in found.offsets(name)}
        assert whole <= read, name
        spans += [(at, at + layout.length) for at in read]
    assert all(end <= start for (_, end), (start, _) in itertools.pairwise(sorted(spans)))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", REAL_LOGS)
def test_a_damaged_real_log_gives_at_least_what_pymavlink_gets(name: str, kind: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(SEED)
    sound = real(name).read_bytes()[:300_000]
    at = len(sound) // 2 + int(rng.integers(500))
    bad, lost_from, lost_to, shift = damaged(sound, kind, at, rng)
    found = BinaryFile("log", memoryview(bad))
    for message, offsets in untouched(BinaryFile("log", memoryview(sound)), lost_from, lost_to, shift).items():
        assert offsets <= set(found.offsets(message).tolist()), message
    path = tmp_path / "damaged.bin"
    path.write_bytes(bad)
    assert sum(found.count(n) for n in found.layouts) >= pymavlink_counts(path).total()


def test_damage_is_reported_with_its_place_its_size_and_its_kind() -> None:
    sound = encode(servo_flight())
    at = int(BinaryFile("log", memoryview(sound)).offsets("RCOU")[50])
    log = open_dataflash(sound[:at] + bytes(512) + sound[at:] + sound[at : at + 5])
    assert [(s.offset, s.length, s.kind) for s in log.stretches] == [
        (at, 512, "zeros"),
        (len(sound) + 512, 5, "truncated"),
    ]
    corrupt, cut = log.damage
    assert (corrupt.kind, corrupt.count, corrupt.note) == ("corrupt", 512, f"512 bytes at byte {at}: zeros")
    assert corrupt.end_s == pytest.approx(7.00002)
    assert corrupt.start_s == pytest.approx(7.0, abs=0.05)
    assert cut.kind == "truncated"


def test_unused_space_of_the_last_flash_page_is_not_damage() -> None:
    log = open_dataflash(encode(servo_flight()) + b"\xff" * 200)
    assert [(s.length, s.kind) for s in log.stretches] == [(200, "erased")]
    assert log.damage == ()


def test_a_message_without_definition_is_reported() -> None:
    sound = encode(servo_flight())
    log = open_dataflash(sound + b"\xa3\x95\xf0" + b"\x01" * 20)
    assert [(s.length, s.kind) for s in log.stretches] == [(23, "unknown_type")]


def test_a_contradictory_length_does_not_cost_a_message() -> None:
    content = bytearray(encode(servo_flight()))
    at = content.index(b"RCOU") - 1
    content[at] = 200
    assert open_dataflash(bytes(content)).count("RCOU") == 100


def test_how_a_firmware_defines_the_definition_is_no_damage() -> None:
    content = encode([Message("RCOU", "QH", {"TimeUS": [10, 20], "C1": [1500, 1600]})])
    own = b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", 128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format")
    log = logparsers.read(io.BytesIO(own + own + content + own))
    assert log["RCOU.C1"].values.tolist() == [1500.0, 1600.0]
    assert log.damage == ()


def test_two_layouts_of_one_name_are_kept_apart() -> None:
    short = Message("RCOU", "QH", {"TimeUS": np.arange(50) * 1000, "C1": np.arange(50)})
    long = Message("RCOU", "QHH", {"TimeUS": np.arange(50) * 1000 + 10**6, "C1": [1] * 50, "C2": [2] * 50})
    log = open_dataflash(encode([short]) + encode([long]))
    assert (log.count("RCOU"), log.count("RCOU~2")) == (50, 50)
    assert log.column("RCOU~2", "C2").tolist() == [2] * 50


HEADERS = encode(servo_flight())[:89] + b"\xa3\x95\x80\x81\x03T".ljust(89, b"\0")
HOSTILE = {
    "headers": b"\xa3\x95\x80",
    "definitions": HEADERS,
    "different_definitions": None,
    "empty_records": b"\xa3\x95\x81",
    "half_headers": b"\xa3\x95",
    "one_bad_byte_each": b"\xa3\x95\x81\x00",
    "zeros": b"\0",
    "cut_records": b"\xa3\x95\x80\x81\x03\xa3\x95",
}
DAMAGED = ("headers", "one_bad_byte_each", "cut_records")
"""Damaged everywhere: 100 kB have fourteen times the thousand places that are kept, or more."""


@pytest.mark.slow
@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_files_take_bounded_time_and_memory(kind: str) -> None:
    pattern = HOSTILE[kind]
    size = 100_000 if kind in DAMAGED else 1_000_000
    if pattern is None:
        names = [b"%04X" % i for i in range(size // 89)]
        body = b"".join(b"\xa3\x95\x80\x82\x0b" + n + b"Q".ljust(16, b"\0") + b"TimeUS".ljust(64, b"\0") for n in names)
    else:
        body = pattern * (size // len(pattern))
    begin = time.process_time()
    with contextlib.suppress(LogError):
        log = open_dataflash(HEADERS + body)
        use_up(log)
        assert len(log.stretches) <= 1000
        assert len(log.damage) <= 3001
    assert time.process_time() - begin < 20e-6 * size


def test_useless_files_are_refused_with_a_reason(tmp_path: Path) -> None:
    with pytest.raises(EmptyLog, match="empty"):
        open_dataflash(b"")
    with pytest.raises(UnreadableLog, match="FMT"):
        open_dataflash(b"time_s,elevator_cmd_deg\n0,1\n")
    with pytest.raises(UnreadableLog, match="FMT"):
        open_dataflash(bytes(5000))
    with pytest.raises(MissingLog, match=r"none\.bin"):
        open_dataflash(tmp_path / "none.bin")
    (tmp_path / "empty.bin").touch()
    with pytest.raises(EmptyLog):
        open_dataflash(tmp_path / "empty.bin")


# -- text -------------------------------------------------------------------------------------------------


def test_the_text_form_gives_what_pymavlink_gives(tmp_path: Path) -> None:
    path = tmp_path / "made.log"
    path.write_bytes(as_text(servo_flight()))
    log = open_dataflash(path)
    seen: Counter[str] = Counter()
    with DFReader.DFReader_text(str(path)) as reader:
        tables = {n: log.table(n) for n in log.names}
        while (row := reader.recv_msg()) is not None:
            name = row.get_type()
            if name == "UNIT":  # pymavlink drops the one with an empty label
                continue
            for field in row.get_fieldnames():
                if name not in ("FMT", "ODD"):
                    value = getattr(row, field)
                    assert same_value(tables[name][field][seen[name]], value), (name, field, value)
            seen[name] += 1
    assert {n: log.count(n) for n in log.names if n != "UNIT"} == seen


def test_the_text_form_gives_what_the_binary_form_gives() -> None:
    text, binary = open_dataflash(as_text(servo_flight())), open_dataflash(encode(servo_flight()))
    assert list(channels(text)) == [c for c in channels(binary) if c != "ODD.M"]
    for name in ("RCOU.C1", "CSRV[8].Pos", "SCAL.c", "PLN.q", "ODD.Half"):
        mine, other = channels(text)[name], channels(binary)[name]
        assert mine.unit == other.unit
        assert (mine.time_s == other.time_s).all()
        assert np.allclose(mine.values, other.values, rtol=1e-6)
    assert text.parameters == binary.parameters
    assert text.texts == binary.texts
    assert text.instances("CSRV") == (0, 1, 8)


def test_bad_lines_of_a_text_log_are_reported() -> None:
    content = as_text(servo_flight()).replace(b"\nRCOU", b"\nRCO\x00, 1\nRCOU, 12\nRCOU", 1)
    log = open_dataflash(content)
    assert log.count("RCOU") == 100
    assert [s.kind for s in log.stretches] == ["bad_line", "bad_line"]
    broken = content.replace(b", 1500,", b", 15x0,", 1)
    assert np.isnan(open_dataflash(broken).column("RCOU", "C1")).sum() == 1


@pytest.mark.parametrize("wrong", [b"9000000", b"-5", b"18446744073709551615", b"1e300", b"x", b"nan"])
def test_one_wrong_time_stamp_in_a_text_log_is_not_believed(wrong: bytes) -> None:
    content = as_text(servo_flight())
    stamps = open_dataflash(content).times_us("RCOU")
    log = open_dataflash(content.replace(b"RCOU, %d," % stamps[50], b"RCOU, %s," % wrong))
    assert log.damage == ()
    assert channels(log)["RCOU.C1"].values.size == 99
    assert (channels(log)["RCOU.C1"].time_s == np.delete(stamps, 50) / 1e6).all()
    (lost,), _ = channels(log).survey()
    assert (lost.kind, lost.count) == ("out_of_order", 1)


def test_after_reboots_every_time_is_on_the_base_of_the_log() -> None:
    def run(start_us: int) -> bytes:
        stamps = start_us + 40_000 * np.arange(50)
        return encode([Message("RCOU", "QH", {"TimeUS": stamps, "C1": [1500] * 50})])

    content = run(5_000_000) + run(1_000_000) + bytes(600) + run(3_000_000)
    log = logparsers.read(io.BytesIO(content))
    assert [damage.kind for damage in log.damage if damage.kind == "reboot"] == ["reboot"]
    (boot_s,) = log.boots_s
    stamps = log["RCOU.C1"].time_s
    assert boot_s in stamps
    assert np.isclose(boot_s, stamps[49] + 1.0)
    (hurt,) = (damage for damage in log.damage if damage.kind == "corrupt")
    assert hurt.start_s is not None
    assert hurt.start_s > boot_s


def test_a_clock_that_jumps_by_more_than_a_day_goes_on() -> None:
    stamps = [20_000 * k + 9 * 10**12 * (k >= 100) for k in range(200)]
    rows = [f"RCOU, {time_us}, {k}" for k, time_us in enumerate(stamps)]
    log = logparsers.read(io.BytesIO("\n".join(["FMT, 7, 13, RCOU, QH, TimeUS,C1", *rows]).encode()))
    assert log["RCOU.C1"].values.size == 200
    assert log.duration_s < 6.0
    assert [damage.kind for damage in log.damage] == ["clock_jump"]
