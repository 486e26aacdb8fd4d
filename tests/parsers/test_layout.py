"""Tables with names of their own: layouts, runs and filters."""

from __future__ import annotations

import io
import pickle
from typing import Any

import numpy as np
import pytest

import logparsers
from logparsers import ClockError, EmptyLog, FlightLog, MissingChannel, SeveralRuns, TableLayout, UnreadableLog
from tests.parsers import writers


def read(content: str | bytes, **layout: Any) -> FlightLog:
    raw = content.encode() if isinstance(content, str) else content
    return logparsers.read(io.BytesIO(raw), TableLayout(**layout))


def test_the_bench_output_of_the_thesis() -> None:
    content = writers.table({"meas": [10, 11, 12], "pwm": [0, 1, 0], "cmd": [500.0, 500.0, 900.0]}, "\t", header=False)
    log = read(content, columns=("meas", "pwm", "cmd"), sample_rate_hz=1000.0, units={"meas": "count"})
    np.testing.assert_array_equal(log["cmd"].values, [500.0, 500.0, 900.0])
    np.testing.assert_array_equal(log["meas"].time_s, [0.0, 0.001, 0.002])
    assert (log["meas"].unit, log["pwm"].unit) == ("count", "")


def test_a_lost_row_leaves_its_place_on_the_clock() -> None:
    log = read("1,2\n3\n5,6\n", columns=("a", "b"), sample_rate_hz=10.0)
    np.testing.assert_allclose(log["a"].time_s, [0.0, 0.2])


@pytest.mark.parametrize(("unit", "seconds"), [("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9)])
def test_time_units(unit: str, seconds: float) -> None:
    log = read("t,x\n1000,1\n3000,2\n", time="t", time_unit=unit)
    np.testing.assert_allclose(log["x"].time_s, [1000 * seconds, 3000 * seconds])


BENCH = "run,kp,t_s,cmd\n1,100,0,5\n1,100,1,6\n2,400,0,7\nb,100,0,8\n2,400,1,9\n"


def test_runs_are_never_joined() -> None:
    logs = logparsers.read_all(io.BytesIO(BENCH.encode()), TableLayout(time="t_s", run="run"))
    assert [(log.run, log["cmd"].values.tolist()) for log in logs] == [("1", [5, 6]), ("2", [7, 9]), ("b", [8])]
    assert [list(log.channels) for log in logs] == [["kp", "cmd"]] * 3


def test_one_log_of_several_must_be_chosen() -> None:
    with pytest.raises(SeveralRuns, match=r"holds 3 runs \(1, 2, b\); pick one with where = \{'run': '1'\}"):
        read(BENCH, time="t_s", run="run")
    log = read(BENCH, time="t_s", run="run", where={"run": "2"})
    assert (log.run, log["cmd"].values.tolist()) == ("2", [7, 9])


def test_where_filters_rows_and_keeps_the_column() -> None:
    logs = logparsers.read_all(io.BytesIO(BENCH.encode()), TableLayout(time="t_s", run="run", where={"kp": "100"}))
    assert [log.run for log in logs] == ["1", "b"]
    assert logs[0]["kp"].values.tolist() == [100, 100]


def test_where_nothing_fits_names_what_there_is() -> None:
    with pytest.raises(EmptyLog, match="no row where kp is '200'; that column holds 100, 400"):
        read(BENCH, time="t_s", run="run", where={"kp": "200"})


def test_runs_joined_by_mistake_are_noticed() -> None:
    with pytest.raises(ClockError, match="split the log there"):
        read("t_s,x\n" + "".join(f"{k % 50},1\n" for k in range(200)), time="t_s")


def test_every_run_starts_its_own_clock() -> None:
    content = "a,1\na,2\nb,3\nb,4\n"
    layout = TableLayout(columns=("run", "x"), run="run", sample_rate_hz=2.0)
    logs = logparsers.read_all(io.BytesIO(content.encode()), layout)
    assert [log["x"].time_s.tolist() for log in logs] == [[0.0, 0.5], [0.0, 0.5]]


def test_a_measurement_is_no_run() -> None:
    content = "t_s,x,y\n" + "".join(f"{k},{k},{k}\n" for k in range(10_001))
    with pytest.raises(UnreadableLog, match="10001 different texts: not runs"):
        read(content, time="t_s", run="x")


@pytest.mark.parametrize(
    ("layout", "name"),
    [({"time": "t"}, "t"), ({"run": "trial"}, "trial"), ({"where": {"kp": "1"}}, "kp"), ({"units": {"u": "V"}}, "u")],
)
def test_columns_of_a_layout_must_exist(layout: dict[str, Any], name: str) -> None:
    with pytest.raises(MissingChannel, match=f"no column '{name}'; its columns are time_s, x"):
        read("time_s,x\n0,1\n", **layout)


@pytest.mark.parametrize(
    "layout", [{"time_unit": "min"}, {"sample_rate_hz": 0.0}, {"sample_rate_hz": np.nan}, {"columns": ("a", "a")}]
)
def test_a_layout_is_checked_where_it_is_made(layout: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"must|is one of"):
        TableLayout(**layout)


def test_a_layout_owns_its_mappings_and_can_be_sent_to_a_worker() -> None:
    where = {"run": "1"}
    layout = TableLayout(where=where)
    where["run"] = "2"
    assert pickle.loads(pickle.dumps(layout)).where == {"run": "1"}  # noqa: S301 - our own bytes
