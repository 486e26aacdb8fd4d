"""Tables that need no layout: spellings, damage, and what is refused."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

import logparsers
from logparsers import EmptyLog, FlightLog, MissingChannel, TableLayout, UnreadableLog
from tests.parsers import writers

HEADER = b"time_s,tail_cmd_deg,tail_pos_deg,note,volts\n"


def read(content: bytes | str, **layout: Any) -> FlightLog:
    raw = content.encode() if isinstance(content, str) else content
    return logparsers.read(io.BytesIO(raw), TableLayout(**layout) if layout else None)


def kinds(log: FlightLog) -> list[tuple[str, int]]:
    return [(damage.kind, damage.count) for damage in log.damage]


@pytest.mark.parametrize(
    "content",
    [
        "time_s,x\n0.0,1.5\n0.5,2.5\n",
        "time_s;x\n0,0;1,5\n0,5;2,5\n",
        "time_s;x\n0.0;1.5\n0.5;2.5\n",
        "time_s\tx\n0.0\t1.5\n0.5\t2.5\n",
        "time_s\tx\n0,0\t1,5\n0,5\t2,5\n",
        "time_s   x\n  0.0  1.5\n  0.5\t2.5  \n",
        "\ufefftime_s,x\r\n0.0,1.5\r\n0.5,2.5\r\n",
        "time_s,x\r0.0,1.5\r0.5,2.5",
        "# bench 3\n\n  # second try\ntime_s,x\n0.0,1.5\n\n0.5,2.5\n\n",
        '"time_s","x"\n"0.0","1.5"\n"0.5",2.5\n',
        '"time_s";"x"\n"0,0";"1,5"\n"0,5";"2,5"\n',
        "time_s , x\n 0.0 , 1.5\n0.5, 2.5\n",
        "time_s,x,\n0.0,1.5,\n0.5,2.5,\n",
        "time_s,x,\n0.0,1.5\n0.5,2.5\n",
        "time_s,x\n0.0,1.5,\n0.5,2.5,\n",
        "time_s,x\n0,+1.5\n5e-1,25E-1\n",
    ],
)
def test_one_table_in_many_spellings(content: str) -> None:
    log = read(content)
    assert list(log.channels) == ["x"]
    np.testing.assert_array_equal(log["x"].time_s, [0.0, 0.5])
    np.testing.assert_array_equal(log["x"].values, [1.5, 2.5])
    assert log.damage == ()


def test_rows_may_begin_after_any_number_of_blank_lines() -> None:
    log = read("time_s;x\n" + "\n" * 600_000 + "0,0;1,5;\n0,5;2,5;\n")  # more than is read at once
    np.testing.assert_array_equal(log["x"].time_s, [0.0, 0.5])
    np.testing.assert_array_equal(log["x"].values, [1.5, 2.5])


def test_units_come_from_the_names() -> None:
    names = ("fin_cmd_deg", "fin_pos_deg", "airspeed_m_s", "servo_voltage_v", "gyro_rad_s", "pulse_us", "mode", "s")
    log = read(writers.table({"time_s": [0.0, 1.0], **{name: [1, 2] for name in names}}))
    assert [log[name].unit for name in names] == ["deg", "deg", "m/s", "V", "rad/s", "us", "", ""]


@pytest.mark.parametrize("cell", ["", "nan", "NaN", "NAN", "nAn", " nan ", "-nan"])
def test_missing_cells_are_blank_and_counted_once_per_column(cell: str) -> None:
    log = read(f"time_s,tail_pos_deg,volts\n0,1,5\n1,{cell},5\n2,{cell},5\n3,4,5\n")
    np.testing.assert_array_equal(log["tail_pos_deg"].values, [1.0, np.nan, np.nan, 4.0])
    assert kinds(log) == [("non_finite", 2)]
    assert (log.damage[0].start_s, log.damage[0].end_s) == (1.0, 2.0)


@pytest.mark.parametrize("cell", ["inf", "-inf", "Infinity", "1e999"])
def test_infinite_cells_are_blank_and_counted(cell: str) -> None:
    log = read(f"time_s,x\n0,1\n1,{cell}\n2,3\n")
    np.testing.assert_array_equal(log["x"].values, [1.0, np.nan, 3.0])
    assert kinds(log) == [("non_finite", 1)]
    assert "1 infinite" in log.damage[0].note


def test_a_column_without_any_value_stays_a_channel() -> None:
    log = read("time_s,tail_pos_deg\n0,\n1,\n")
    assert np.isnan(log["tail_pos_deg"].values).all()


def test_a_label_column_is_left_out_silently() -> None:
    log = read("time_s,x,type,armed\n0,1,chirp,True\n1,2,,False\n")
    assert list(log.channels) == ["x"]
    assert log.damage == ()


@pytest.mark.parametrize("cell", ["off", "1_000", "0x1F", "1.2.3", "True", "NA", "null", "--"])
def test_a_column_with_some_text_is_left_out_and_told(cell: str) -> None:
    log = read(f"# c\ntime_s,x,volts\n0,1,5\n1,1,{cell}\n2,1,{cell}\n")
    assert list(log.channels) == ["x"]
    assert kinds(log) == [("not_numeric", 2)]
    assert f"line 4, column 'volts': {cell!r}" in log.damage[0].note


@pytest.mark.parametrize(
    ("column", "layout"),
    [
        ("time_s", {}),
        ("tail_cmd_deg", {}),
        ("tail_pos_deg", {}),
        ("volts", {"units": {"volts": "V"}}),
        ("volts", {"time": "volts"}),
    ],
)
def test_text_in_a_column_that_matters_is_fatal(column: str, layout: Mapping[str, Any]) -> None:
    row = {"time_s": "1", "tail_cmd_deg": "2", "tail_pos_deg": "3", "note": "x", "volts": "5"} | {column: "#REF!"}
    content = HEADER + b"0,1,2,x,4\n\n" + ",".join(row.values()).encode() + b"\n"
    with pytest.raises(UnreadableLog, match=f"<file>: line 4, column '{column}': '#REF!' is not a number"):
        read(content, **layout)


def test_text_in_a_faser_position_is_fatal() -> None:
    with pytest.raises(UnreadableLog, match="line 3, column 'de_pos': 'x'"):
        read("time,de,de_pos\n0,1,2\n1,1,x\n")


@pytest.mark.parametrize("tail", ["2,1", "2", "2,1,"])
def test_a_last_line_that_is_cut_is_dropped_and_told(tail: str) -> None:
    log = read(f"time_s,x,y,z\n0,1,2,3\n1,1,2,3\n{tail}")
    assert log["x"].values.size == 2
    assert kinds(log) == [("truncated", 1)]
    assert "first line 4" in log.damage[0].note


def test_a_short_line_in_the_middle_is_dropped_and_told() -> None:
    log = read("time_s,x,y\n0,1,2\n1,1\n2,1,2\n")
    np.testing.assert_array_equal(log["x"].time_s, [0.0, 2.0])
    assert kinds(log) == [("truncated", 1)]


@pytest.mark.parametrize("quote", ["", '"'])
def test_too_many_cells_name_the_line(quote: str) -> None:
    with pytest.raises(UnreadableLog, match="line 4 has 4 cells, but the table has 3 columns"):
        read(f"# c\ntime_s,x,y\n0,1,2\n1,1,2,{quote}3{quote}\n")


def test_a_header_beyond_all_measure() -> None:
    with pytest.raises(UnreadableLog, match="line 1, the header, cannot be read"):
        read("time_s," + "x" * 200_000 + "\n0,1\n")


def test_a_quote_that_is_never_closed() -> None:
    with pytest.raises(UnreadableLog, match="close every quote"):
        read('time_s,x\n0,1\n1,"2\n2,3\n')


def test_a_quoted_cell_may_hold_the_delimiter_and_a_newline() -> None:
    log = read('time_s,note,x,y\n0,"a,b",1,1\n1,"two\nlines",2,2\n2,c,3,bad\n')
    np.testing.assert_array_equal(log["x"].values, [1, 2, 3])
    assert "line 5, column 'y': 'bad'" in log.damage[0].note


@pytest.mark.parametrize("content", ["time_s,x", "time_s,x\n", "time_s,x\n\n \n", "# only\n# comments\n", "\n\n", " "])
def test_no_row_is_an_empty_log(content: str) -> None:
    with pytest.raises(EmptyLog):
        read(content)


def test_rows_without_any_time_are_an_empty_log() -> None:
    with pytest.raises(EmptyLog, match="none of its 2 rows has a time stamp"):
        read("time_s,x\n,1\n,2\n")


@pytest.mark.parametrize("junk", [b"\0", b"\x01", b"\x7f"])
def test_bytes_that_are_no_text_are_placed(junk: bytes) -> None:
    with pytest.raises(UnreadableLog, match=rf"line 3 holds the byte 0x{junk[0]:02X}"):
        read(b"time_s,x\n0,1\n1," + junk + b"\n")


def test_two_columns_of_one_name() -> None:
    with pytest.raises(UnreadableLog, match=r"line 2: the header has two columns 'x'"):
        read("# c\ntime_s,x,y,x\n0,1,2,3\n")


def test_no_time_column_names_what_there_is() -> None:
    with pytest.raises(MissingChannel, match=r"no column 'time_s'.* in t, x; name the time column"):
        read("t,x\n0,1\n")


def test_no_header_is_recognised() -> None:
    with pytest.raises(MissingChannel, match="line 1 is data, no header; name its columns"):
        read("512\t0\t-1.5e3\t0\n513\t0\t500\t0\n")


def test_time_alone_is_no_log() -> None:
    with pytest.raises(MissingChannel, match="no column of numbers beside the time"):
        read("time_s,note\n0,a\n1,b\n")
    with pytest.raises(MissingChannel, match=r"beside the time; .* line 3, column 'x': 'b' is not a number"):
        read("time_s,x\n0,1\n1,b\n")


def test_time_s_wins_over_the_names_of_faser() -> None:
    assert read("time_s,time,de\n0,9,1\n1,8,2\n").format == "table"


def test_damaged_stamps_are_dropped() -> None:
    log = read("time_s,x\n0,1\n1,2\n1,3\n,4\n2,5\n3,6\n")
    np.testing.assert_array_equal(log["x"].values, [1, 2, 5, 6])
    assert kinds(log) == [("non_finite", 1), ("out_of_order", 1)]


def test_rows_of_one_stamp_are_one_row() -> None:
    """A logger writes commands and positions in rows of their own: the same log as with both in one row."""
    apart = read("time_s,a_cmd_deg,a_pos_deg\n0,1,\n0,,2\n0.1,3,\n0.1,,4\n0.2,5,\n0.2,,6\n")
    together = read("time_s,a_cmd_deg,a_pos_deg\n0,1,2\n0.1,3,4\n0.2,5,6\n")
    for name in together.channels:
        np.testing.assert_array_equal(apart[name].time_s, together[name].time_s)
        np.testing.assert_array_equal(apart[name].values, together[name].values)
    assert apart.damage == ()


def test_rows_of_two_sources_may_pass_each_other() -> None:
    log = read("time_s,a,b\n0,1,\n0.03,,7\n0.02,2,\n0.04,3,\n0.05,,8\n")
    np.testing.assert_allclose(log["a"].time_s, [0.0, 0.02, 0.03, 0.04, 0.05])
    np.testing.assert_array_equal(log["a"].values, [1, 2, np.nan, 3, np.nan])
    np.testing.assert_array_equal(log["b"].values, [np.nan, np.nan, 7, np.nan, 8])
    assert log.damage == ()


def test_a_stamp_that_comes_again_with_another_value_is_counted_and_refuses_nothing() -> None:
    rows = "".join(f"{k // 2 / 10},{k}\n" for k in range(40))
    log = read("time_s,x\n" + rows)
    np.testing.assert_array_equal(log["x"].values, np.arange(0, 40, 2))
    assert kinds(log) == [("out_of_order", 20)]
    assert "20 rows with a time stamp again but other values left out, first row 2" in log.damage[0].note


def test_numbers_are_read_to_the_last_bit() -> None:
    values = np.random.default_rng(5).normal(size=5000) * 10.0 ** np.arange(-10, 10).repeat(250)
    log = read(writers.table({"time_s": np.arange(5000), "x": values.tolist()}))
    np.testing.assert_array_equal(log["x"].values, values)
