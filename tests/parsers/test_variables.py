from __future__ import annotations

import contextlib
import io
import struct
import tracemalloc
import zlib
from typing import Any, cast

import h5py
import numpy as np
import pytest
from scipy.io import loadmat

import logparsers
from logparsers import FlightLog, LogError, MissingChannel, TableLayout, TruncatedLog, UnreadableLog
from logparsers.archive import LIMIT_VARIABLE
from tests.parsers import writers
from tests.parsers.writers import COMMAND, FLIGHT, POSITION, TIME_S


def read(content: bytes) -> FlightLog:
    return logparsers.read(io.BytesIO(content))


def test_level_4_agrees_with_scipy_in_every_type_of_the_flight_computer() -> None:
    counts = np.rint(POSITION * 1000)
    content = writers.level4(
        {"time": ("f8", TIME_S), "de": ("f4", COMMAND / 3), "da_l_pos": ("i4", counts), "mode": ("i2", counts)}
    )
    theirs: dict[str, Any] = loadmat(cast("Any", io.BytesIO(content)))
    log = read(content)
    for name in ("de", "da_l_pos", "mode"):
        np.testing.assert_array_equal(log[name].values, theirs[name].ravel())
    assert [log[name].unit for name in ("de", "da_l_pos", "mode")] == ["rad", "rad_or_count", ""]


def test_level_5_agrees_with_scipy_where_matlab_stored_doubles_as_bytes() -> None:
    # MATLAB shrinks whole numbers to the smallest type that holds them, in "small elements" up to four bytes.
    content = bytearray(writers.matlab({"time": np.array([0.0, 1.0]), "de": np.array([1.0, 2.0])}))
    start = content.index(struct.pack("<2I2d", 9, 16, 1.0, 2.0))
    content[start : start + 24] = struct.pack("<2H2B2x", 1, 2, 1, 2)
    content[start + 8 :] = b""
    matrix = content.rindex(struct.pack("<I", 14), 0, start)
    content[matrix + 4 : matrix + 8] = struct.pack("<I", len(content) - matrix - 8)
    theirs: dict[str, Any] = loadmat(cast("Any", io.BytesIO(bytes(content))))
    np.testing.assert_array_equal(read(bytes(content))["de"].values, theirs["de"].ravel())


def test_a_big_endian_level_5_file() -> None:
    content = writers.level5(">", writers.vector5(">", "time", TIME_S), writers.vector5(">", "dr", COMMAND))
    log = read(content)
    np.testing.assert_array_equal(log["dr"].values, COMMAND)
    np.testing.assert_array_equal(log["dr"].time_s, TIME_S)


FIELDS = writers.element5("<", 5, struct.pack("<i", 8)) + writers.element5("<", 1, b"de".ljust(8, b"\0"))
FRAME = (
    writers.element5("<", 6, struct.pack("<2I", 2, 0))
    + writers.element5("<", 5, struct.pack("<2i", 1, 1))
    + writers.element5("<", 1, b"s")
)


@pytest.mark.parametrize(
    ("element", "message"),
    [
        (writers.vector5("<", "de", COMMAND, kind=8), "values of unknown type 8"),
        (writers.element5("<", 15, zlib.compress(struct.pack("<2I", 14, 999))), "holds 0 of 999 bytes"),
        (writers.element5("<", 15, b"no deflate"), "decompress"),
        (writers.element5("<", 14, FRAME + FIELDS.replace(struct.pack("<2Ii", 5, 4, 8), bytes(12))), "MATLAB level-5"),
        (writers.element5("<", 14, FRAME + writers.element5("<", 5, bytes(4)) + FIELDS), "field names of 0 bytes"),
        (writers.element5("<", 14, FRAME + struct.pack("<2I", 5, 400)), "an element of 400 bytes does not fit"),
        (writers.element5("<", 14, struct.pack("<2HI", 6, 8, 0)), "an element of 8 bytes does not fit into the 4"),
    ],
)
def test_level_5_elements_that_contradict_themselves(element: bytes, message: str) -> None:
    with pytest.raises(UnreadableLog, match=message):
        read(writers.level5("<", writers.vector5("<", "time", TIME_S), element))


def test_an_empty_field_of_a_structure_is_passed_over() -> None:
    empty = writers.element5("<", 14, FRAME + FIELDS + writers.element5("<", 14, b""))
    vectors = [writers.vector5("<", name, FLIGHT[name]) for name in ("time", "de")]
    assert list(read(writers.level5("<", empty, *vectors)).channels) == ["de"]


@pytest.mark.parametrize("content", [writers.flight_level4(), writers.matlab(FLIGHT)])
def test_a_file_cut_inside_a_header(content: bytes) -> None:
    with pytest.raises(TruncatedLog, match="the header of a variable"):
        read(content + content[128:132])


def test_a_cut_level_4_file_names_the_lost_variable_and_the_bytes() -> None:
    content = writers.flight_level4()
    with pytest.raises(TruncatedLog, match=rf"inside 'de_pos': it has {len(content) - 1} bytes .* {len(content)}"):
        read(content[:-1])


@pytest.mark.parametrize("compressed", [False, True])
def test_a_cut_level_5_file_names_the_lost_variable(*, compressed: bool) -> None:
    with pytest.raises(TruncatedLog, match="inside 'de_pos'"):
        read(writers.matlab(FLIGHT, compressed=compressed)[:-30])


def test_a_cut_hdf5_file() -> None:
    with pytest.raises(UnreadableLog, match=r"HDF5.*truncated"):
        read(writers.raptrs()[:-100])


def test_forged_sizes_do_not_allocate() -> None:
    content = bytearray(writers.flight_level4())
    content[4:8] = struct.pack(">i", 2**31 - 1)
    with pytest.raises(TruncatedLog, match=r"inside 'time'.* needs at least 8589934"):
        read(bytes(content))


def test_hdf5_sets_without_numbers_or_never_written_are_not_read() -> None:
    file = io.BytesIO(writers.raptrs())
    with h5py.File(file, "a") as h5:
        h5["Control/text"] = np.bytes_("note")
        h5["Control/empty"] = np.zeros(2, dtype=np.uint64)
        h5["Control/empty"].attrs["MATLAB_empty"] = 1
        h5["Control/char"] = np.arange(COMMAND.size, dtype=np.uint16)
        h5["Control/char"].attrs["MATLAB_class"] = np.bytes_("char")
        h5.create_dataset("Control/never_written", shape=(2**40,), dtype="f8", chunks=(1024,))
    log = read(file.getvalue())
    assert list(log.channels) == ["cmdElev_rad", "cmdMotor_nd", "Input_V"]
    assert log.damage == ()


def test_a_channel_of_another_length_is_left_out_and_told() -> None:
    log = read(writers.matlab({**FLIGHT, "gps": np.zeros(7), "gain": 3.0}))
    assert list(log.channels) == ["de", "de_pos"]
    (damage,) = log.damage
    assert (damage.kind, damage.count) == ("wrong_length", 1)
    assert "gps (7)" in damage.note


def test_not_finite_values_are_counted_and_blank() -> None:
    values = COMMAND.copy()
    values[[3, 9]] = np.nan, np.inf
    log = read(writers.level4({"time": ("f8", TIME_S), "de": ("f8", values)}))
    assert np.flatnonzero(np.isnan(log["de"].values)).tolist() == [3, 9]
    (damage,) = log.damage
    assert (damage.kind, damage.count, damage.start_s, damage.end_s) == ("non_finite", 2, TIME_S[3], TIME_S[9])
    assert "1 infinite" in damage.note


def test_equal_names_in_different_groups_keep_their_paths() -> None:
    content = writers.hdf5(
        {
            "Backup/cmdRud_rad": POSITION,
            "Control/cmdRud_rad": COMMAND,
            "Sensors/Fmu/Time_us": np.arange(COMMAND.size) * 20_000,
        }
    )
    log = read(content)
    np.testing.assert_array_equal(log["cmdRud_rad"].values, COMMAND)
    np.testing.assert_array_equal(log["Backup/cmdRud_rad"].values, POSITION)


def test_the_clock_is_the_one_beside_the_commands() -> None:
    log = read(writers.matlab({"weather": {"time": np.arange(3.0)}, "flight": FLIGHT}))
    np.testing.assert_array_equal(log["de"].time_s, TIME_S)


def test_a_frozen_position_stays_a_channel() -> None:
    log = read(writers.matlab({**FLIGHT, "df_l_pos": np.full(TIME_S.size, 2048.0)}))
    assert log["df_l_pos"].is_constant


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ({"de": COMMAND, "clock": TIME_S}, "no variable 'time'.* it has de, clock; name its clock or its rate"),
        ({"time": TIME_S, "gain": 3.0}, "nothing but a clock in it; it has time, gain"),
        ({"time": TIME_S, "de": COMMAND[:-4]}, "'de' has 116 values"),
        ({"note": "text only"}, "no numeric variables"),
    ],
)
def test_a_matlab_file_that_is_no_flight(variables: dict[str, Any], message: str) -> None:
    with pytest.raises(MissingChannel, match=message):
        read(writers.matlab(variables))


def test_names_of_ones_own_make_channels_each_beside_its_own_clock() -> None:
    slow = TIME_S[::4] + 0.001
    log = read(
        writers.matlab(
            {
                "fast": {"t": TIME_S, "elev": COMMAND, "pots": np.stack([POSITION, -POSITION], axis=1)},
                "slow": {"t": slow, "volts": np.arange(slow.size, dtype=np.int16)},
            }
        )
    )
    assert (log.format, list(log.channels)) == ("table", ["elev", "pots[0]", "pots[1]", "volts"])
    np.testing.assert_array_equal(log["pots[1]"].values, -POSITION)
    np.testing.assert_array_equal(log["volts"].values, np.arange(slow.size))
    np.testing.assert_array_equal(log["volts"].time_s, slow)
    np.testing.assert_array_equal(log["elev"].time_s, TIME_S)


@pytest.mark.parametrize("clock", ["stamp", "rig/stamp", "/rig/stamp"])
@pytest.mark.parametrize("hdf5", [False, True])
def test_a_layout_names_the_clock(clock: str, *, hdf5: bool) -> None:
    rig = {"stamp": TIME_S * 1e3, "elev": COMMAND}
    content = writers.hdf5({f"rig/{k}": v for k, v in rig.items()}) if hdf5 else writers.matlab({"rig": rig})
    log = logparsers.read(io.BytesIO(content), TableLayout(time=clock, time_unit="ms"))
    np.testing.assert_allclose(log["elev"].time_s, TIME_S, rtol=0.0, atol=1e-12)
    log = logparsers.read(io.BytesIO(content), TableLayout(sample_rate_hz=50.0))
    np.testing.assert_allclose(log["elev"].time_s, TIME_S - TIME_S[0], rtol=0.0, atol=1e-12)
    assert "stamp" in log.channels


OPAQUE = writers.element5(
    "<",
    14,
    writers.element5("<", 6, struct.pack("<2I", 17, 0))
    + writers.element5("<", 1, b"label")  # five letters: no multiple of four, as an array of dimensions would be
    + writers.element5("<", 1, b"MCOS")
    + writers.element5("<", 1, b"string")
    + writers.element5("<", 14, b""),
)


def test_objects_strings_and_functions_are_stepped_over() -> None:
    vectors = [writers.vector5("<", name, FLIGHT[name]) for name in ("time", "de")]
    assert list(read(writers.level5("<", OPAQUE, *vectors, OPAQUE)).channels) == ["de"]


def peak_mb(content: bytes) -> float:
    """What reading takes beyond the content itself, whether it succeeds or not."""
    tracemalloc.start()
    with contextlib.suppress(LogError):
        log = read(content)
        for name in log.channels:
            log[name].values.sum()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / 2**20


def test_no_matlab_file_takes_more_than_six_times_its_size_beyond_one_channel() -> None:
    rows = 400_000
    file = {"time": np.arange(rows) / 1e3} | {f"c{k}": np.full(rows, k, np.int8) for k in range(8)}
    content = writers.matlab(file)
    channel_mb = 8 * rows / 2**20
    assert peak_mb(content) < 6 * len(content) / 2**20 + 2 * channel_mb


@pytest.mark.slow
def test_many_small_cells_take_no_memory_to_speak_of() -> None:
    empty = writers.element5("<", 14, b"")
    cells = writers.element5(
        "<",
        14,
        writers.element5("<", 6, struct.pack("<2I", 1, 0))
        + writers.element5("<", 5, struct.pack("<2i", 1, 500_000))
        + writers.element5("<", 1, b"c")
        + empty * 500_000,
    )
    packed = writers.element5("<", 15, zlib.compress(cells))
    assert peak_mb(writers.level5("<", packed)) < 60


@pytest.mark.slow
@pytest.mark.parametrize("promise", [0, 1 << 31, (1 << 32) - 1])
def test_a_compressed_variable_inflates_as_far_as_its_header_promises(promise: int) -> None:
    bomb = zlib.compress(struct.pack("<2I", 14, promise) + bytes(64 << 20), 1)
    content = writers.level5("<", writers.vector5("<", "time", TIME_S), writers.element5("<", 15, bomb))
    assert peak_mb(content) < 10
    if promise:
        with pytest.raises(UnreadableLog, match="unpacks to more than 1024 MB"):
            read(content)


@pytest.mark.slow
def test_an_hdf5_bomb_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(LIMIT_VARIABLE, "20")
    content = writers.hdf5({"time": np.zeros(8 << 20)}, compression="gzip")
    assert len(content) < 200_000
    with pytest.raises(UnreadableLog, match="unpacks to more than 20 MB"):
        read(content)


def test_structures_within_structures_have_an_end() -> None:
    variables: dict[str, Any] = dict(FLIGHT)
    for _ in range(20):
        variables = {"s": variables}
    with pytest.raises(UnreadableLog, match="more than 16 structures"):
        read(writers.matlab(variables))


def test_an_hdf5_index_that_leads_back_into_itself_is_refused() -> None:
    """The HDF5 library follows it for ever: this hung a seeded mutation."""
    content = bytearray(writers.raptrs())
    node = content.index(b"TREE")
    content[node + 16 : node + 24] = struct.pack("<Q", node)  # its right sibling is itself
    with pytest.raises(UnreadableLog, match="runs in circles"):
        logparsers.read(io.BytesIO(bytes(content)))
