"""Results for a notebook: short, complete, and told from the same numbers as everything else."""

from __future__ import annotations

import contextlib
import io
import math
import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import servofd
from logparsers import LogError
from servofd.cli import main
from servofd.core.errors import ConfigError, NoMeasurement, UnknownName
from servofd.simulation.airframe import airframe_log, fly_airframe
from tests.fleet.conftest import in_line

ROOT = Path(__file__).parent.parent
STUCK = ROOT / "sample_logs" / "faser_stuck_flight.mat"


@pytest.fixture(scope="module")
def stuck() -> servofd.Audit:
    found = servofd.audit(STUCK, surfaces=("elevator", "rudder"))
    assert isinstance(found, servofd.Audit)
    return found


@pytest.mark.slow
def test_the_page_on_python_runs_and_prints_what_it_shows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sample_logs").symlink_to(ROOT / "sample_logs")
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.setattr("servofd.fleets.run.run_local", in_line)
    page = (ROOT / "docs" / "api.md").read_text()
    known: dict[str, object] = {}
    for code, shown in re.findall(r"```python\n(.*?)```\n\n```text\n(.*?)```", page, re.DOTALL):
        output = io.StringIO()
        with contextlib.redirect_stdout(output):
            exec(compile(code, "api.md", "exec"), known)  # noqa: S102 - our own page
        assert output.getvalue() == shown


@pytest.mark.slow
def test_a_result_is_short_and_a_loop_over_it_gives_itself(stuck: servofd.Audit) -> None:
    assert [one for one in stuck] == [stuck]  # noqa: C416 - as people write it
    assert stuck[0] is stuck
    with pytest.raises(IndexError):
        stuck[1]
    assert len(repr(stuck)) < 400
    assert repr(stuck).count("\n") == 2


@pytest.mark.slow
def test_a_cell_is_escaped_and_needs_nothing(tmp_path: Path) -> None:
    name = "<script>alert(1)</script>"
    found = one_run(rudder().rename(columns=lambda column: column.replace("rudder", name)), servo="hs225bb-eq31")
    for text in (found._repr_html_(), found.save_html(tmp_path / "a.html").read_text()):
        assert "<script>alert" not in text
        assert "&lt;script&gt;alert" in text
    assert not re.search(r"(src|href)=", found._repr_html_())


@pytest.mark.slow
def test_a_table_is_judged_as_its_file(tmp_path: Path) -> None:
    path = tmp_path / "rudder.csv"
    rudder().to_csv(path, index=False)
    of_file, of_table = (one_run(log, servo="hs225bb-eq31") for log in (path, rudder()))
    pd.testing.assert_frame_equal(of_table.to_pandas(), of_file.to_pandas())


@pytest.mark.slow
def test_runs_come_one_after_the_other(tmp_path: Path) -> None:
    table = rudder()
    twice = pd.concat([table.assign(run="first"), table.assign(run="second")])
    found = servofd.audit(twice, servo="hs225bb-eq31")
    assert isinstance(found, servofd.Audits)
    assert found.to_pandas()["run"].tolist() == ["first", "second"]
    assert repr(found).count("OFF BY +2.5 deg") == 2
    assert "run second" in found.save_html(tmp_path / "runs.html").read_text()


def test_errors_come_at_once() -> None:
    with pytest.raises(LogError, match="no such file"):
        servofd.audit("missing.bin")
    with pytest.raises(servofd.ServofdError, match="did you mean elevator"):
        servofd.audit(STUCK, surfaces=("elevtor",))


def test_columns_are_the_numbers_of_the_verdict(stuck: servofd.Audit) -> None:
    row = stuck.to_pandas().set_index("surface").loc["elevator"]
    (fault,) = stuck["elevator"].faults
    assert (row.kind, row.start_s, row.alarm_s) == (fault.kind, fault.start_s, fault.alarm_s)
    series = stuck.series("elevator")
    first = series.index[(series.residual_deg.abs() >= series.threshold_deg) & series.judged][0]
    assert first == pytest.approx(fault.alarm_s, abs=0.03)
    assert len(stuck.plot().axes) == 2
    with pytest.raises(servofd.ServofdError, match="unknown surface"):
        stuck.plot("nothing")


def test_what_is_no_log_is_refused_by_its_type() -> None:
    for wrong in (3, pd.Series([1.0])):
        with pytest.raises(TypeError, match=f"a log is a path, .*, and not of type {type(wrong).__name__}"):
            servofd.audit(wrong)  # type: ignore[arg-type]


def rudder() -> pd.DataFrame:
    return pd.read_csv(ROOT / "sample_logs" / "table_three_faults.csv")[["time_s", "rudder_cmd_deg", "rudder_pos_deg"]]


def renamed(table: pd.DataFrame, **names: str) -> pd.DataFrame:
    return table.rename(columns=names)


def one_run(log: Any, **options: Any) -> servofd.Audit:
    found = servofd.audit(log, **options)
    assert isinstance(found, servofd.Audit)
    return found


CLOCKS: dict[str, Any] = {
    "index": lambda table: table.set_index("time_s"),
    "dates": lambda table: table.set_index(pd.to_datetime(table.time_s, unit="s", utc=True)).drop(columns="time_s"),
    "durations": lambda table: renamed(table.assign(time_s=pd.to_timedelta(table.time_s, unit="s")), time_s="when"),
    "dates as text": lambda table: table.assign(time_s=pd.to_datetime(table.time_s, unit="s").astype(str)),
    "milliseconds": lambda table: renamed(table.assign(time_s=1e3 * table.time_s), time_s="Time [ms]"),
    "objects": lambda table: table.astype(object),
    "arrays": lambda table: {name: table[name].to_numpy() for name in table},
    "text": lambda table: io.StringIO(table.to_csv(index=False)),
    "bytes": lambda table: io.BytesIO(table.to_csv(index=False).encode()),
}


@pytest.mark.slow
@pytest.mark.parametrize("form", CLOCKS)
def test_a_table_is_judged_alike_whatever_holds_it_and_whatever_its_clock(form: str) -> None:
    (fault,) = one_run(CLOCKS[form](rudder()), servo="hs225bb-eq31").rudder.faults
    assert (fault.kind, round(fault.start_s, 1)) == ("bias", 10.1)


@pytest.mark.slow
def test_columns_say_what_a_table_holds_whether_it_is_a_file_or_not(tmp_path: Path) -> None:
    named = {"when": "time_ms", "asked": "rudder_cmd_rad", "done": "rudder_pos_rad"}
    table = rudder()
    other = pd.DataFrame(
        {
            "when": 1e3 * table.time_s,
            "asked": np.radians(table.rudder_cmd_deg),
            "done": np.radians(table.rudder_pos_deg),
        }
    )
    other.to_csv(tmp_path / "bench.csv", index=False)
    for log in (other, tmp_path / "bench.csv"):
        (fault,) = one_run(log, columns=named, servo="hs225bb-eq31").rudder.faults
        assert (fault.kind, round(fault.start_s, 1)) == ("bias", 10.1)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda table: pd.concat([table, table[["rudder_cmd_deg"]]], axis=1), "two columns 'rudder_cmd_deg'"),
        (
            lambda table: table.assign(rudder_pos_deg=["bad" if k == 5 else k for k in range(len(table))]),
            "line 7.*'bad' is not a number",
        ),
        (lambda table: table.sample(frac=1, random_state=1), "time runs backwards.*; sort it by its time"),
        (lambda table: pd.concat([table, table[:100]]), "time runs backwards.*a column run"),
        (lambda table: pd.concat({"a": table}, axis=1), "2 levels of names"),
        (lambda table: table.T, "name the columns"),
        (lambda table: renamed(table, time_s="when"), r"is the time; say which: columns=\{'when': 'time_s'\}"),
        (lambda table: renamed(table, time_s="when")[["rudder_cmd_deg", "when"]], r"columns=\{'when': 'time_s'\}"),
        (lambda table: table.assign(t=0, time_ms=0).drop(columns="time_s"), "t and time_ms may be the time"),
        (lambda _: {"time_s": [0, 1], "rudder_cmd_deg": [1]}, "one array for each column, all of one length"),
        (lambda _: pd.DataFrame(), "it has none"),
    ],
)
def test_a_table_that_is_none_says_what_is_wrong_with_it(change: Any, says: str) -> None:
    with pytest.raises((LogError, servofd.ServofdError), match=rf"^(DataFrame|dict): .*{says}"):
        servofd.audit(change(rudder()))


@pytest.mark.parametrize(
    ("columns", "says"),
    [
        ({"x": "time_s"}, "unknown column 'x'"),
        ({"rudder_cmd_deg": "rudder"}, "'rudder', which is none of time_s"),
        ({"rudder_cmd_deg": "rudder_pos_deg"}, "has a position and no command"),
        ({"rudder_cmd_deg": "a_cmd_deg", "rudder_pos_deg": "a_cmd_deg"}, "are both a_cmd_deg"),
        ({"time_s": "time_s"}, "none is a command"),
    ],
)
def test_columns_that_say_nothing_are_refused(columns: dict[str, str], says: str) -> None:
    with pytest.raises(ConfigError, match=f"^columns: .*{says}"):
        servofd.audit(rudder(), columns=columns)


def test_errors_are_in_words_of_python(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"a level in degrees is threshold_deg=0\.5"):
        servofd.audit(STUCK, threshold=0.5)  # type: ignore[arg-type]
    for level in (-1.0, 0.0, math.nan, math.inf):
        with pytest.raises(ConfigError, match="threshold_deg is a positive number of degrees"):
            servofd.audit(STUCK, threshold_deg=level)
    with pytest.raises(ConfigError, match="a positive number of degrees, not '2'"):
        servofd.audit(STUCK, threshold_deg="2")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=r"surface is the name of one surface, not \['rudder'\]"):
        servofd.explain(STUCK, surface=["rudder"])  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"^servofd\.trend: missing a required argument: 'aircraft'"):
        servofd.trend([STUCK])  # type: ignore[call-arg]
    with pytest.raises(UnknownName, match=r"^fault=rudder:stick@3: .* did you mean stuck"):
        servofd.simulate(fault="rudder:stick@3")
    with pytest.raises(NoMeasurement, match=r"an aircraft file \(aircraft=\)"):
        servofd.audit({"time_s": [0.0, 1.0], "x": [1.0, 2.0]})
    (tmp_path / "x.pkl").write_bytes(pickle.dumps(rudder()))
    with pytest.raises(LogError, match="a Python pickle, which is no log to read"):
        servofd.audit(tmp_path / "x.pkl")


def test_surfaces_are_attributes_that_draw_themselves(stuck: servofd.Audit) -> None:
    from matplotlib.figure import Figure

    assert {"elevator", "rudder", "sentence"} <= set(dir(stuck))
    assert stuck.elevator is stuck["elevator"]
    assert repr(stuck.rudder).startswith("rudder: healthy: followed its command")
    with pytest.raises(AttributeError, match="no attribute 'flap'"):
        _ = stuck.flap
    ax = Figure().add_subplot()
    assert stuck["elevator"].plot(ax=ax) is ax.figure
    assert {line.get_label() for line in ax.lines} >= {"command", "healthy servo", "measured"}
    series = stuck.elevator.series()
    asked = stuck.elevator.segment
    assert asked is not None
    at = np.searchsorted(asked.command_s, series.index[-1], side="right") - 1
    assert series.command_deg.iloc[-1] == asked.command_deg[at]


@pytest.mark.slow
def test_results_are_kept_and_compared(stuck: servofd.Audit) -> None:
    again = pickle.loads(pickle.dumps(stuck))  # noqa: S301 - our own
    assert again == stuck
    assert again.to_html() == stuck.to_html()
    pd.testing.assert_frame_equal(again.series("elevator"), stuck.series("elevator"))
    (elevator, other) = (stuck - again).to_pandas().to_dict("records")
    assert (elevator["status_a"], elevator["status_b"], elevator["max_abs_deg_difference"]) == ("fault", "fault", 0.0)
    assert (stuck - again).sentence == "The same verdicts."
    assert other["surface"] == "rudder"
    upper, _ = servofd.compare(stuck, again).plot("rudder", at_s=(0.0, 2.0)).axes
    first, second = (line.get_xdata() for line in upper.lines)
    assert np.ptp(first - second - 2.0) == pytest.approx(0.0)  # type: ignore[operator]
    with pytest.raises(UnknownName, match="did you mean elevator"):
        (stuck - again).plot("elevtor")


@pytest.mark.slow
def test_every_other_result_is_kept_too(tmp_path: Path) -> None:
    log = ROOT / "sample_logs" / "faser_healthy_chirp.mat"
    flight = ROOT / "sample_logs" / "faser_healthy_flight.mat"
    flown = servofd.simulate(tmp_path / "good.csv", duration_s=20.0)
    assert servofd.load(tmp_path / "good.csv").duration_s == flown.time_s[-1]  # type: ignore[union-attr]
    for result in (
        flown,
        servofd.identify(log),
        servofd.trend(flight, "faser", surfaces=("rudder",), workers=0),
        servofd.calibrate(flight, "faser", surfaces=("elevator",), force=True),
        servofd.explain(
            pd.read_csv(ROOT / "sample_logs" / "hidden" / "hidden_11.csv", nrows=1500), servo="hs225bb-eq31"
        ),
    ):
        again = pickle.loads(pickle.dumps(result))  # noqa: S301 - our own
        pd.testing.assert_frame_equal(again.to_pandas(), result.to_pandas())


@pytest.mark.slow
def test_a_folder_is_a_fleet_and_its_results_are_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("servofd.fleets.run.run_local", in_line)
    for name in ("faser_stuck_flight.mat", "faser_healthy_flight.mat"):
        (tmp_path / name).symlink_to(ROOT / "sample_logs" / name)
    judged = servofd.audit(tmp_path)
    assert isinstance(judged, servofd.Fleet)
    assert main(["audit", str(tmp_path), "-o", str(tmp_path / "results")]) == 1
    pd.testing.assert_frame_equal(servofd.fleet(tmp_path / "results").to_pandas(), judged.to_pandas())
    assert judged.to_pandas().status.tolist() == ["fault", "healthy"]


@pytest.mark.slow
def test_a_table_is_called_what_it_is() -> None:
    found = servofd.audit(rudder(), servo="hs225bb-eq31")
    assert repr(found).splitlines()[0].endswith("(DataFrame, table, 40.0 s)")
    with pytest.raises(ConfigError, match=r"^DataFrame: "):
        servofd.audit(rudder()[["rudder_cmd_deg"]])


@pytest.mark.slow
def test_a_table_is_a_log_for_every_verb_of_one_flight(tmp_path: Path) -> None:
    table = pd.read_csv(ROOT / "sample_logs" / "hidden" / "hidden_07.csv", nrows=1500)
    table.to_csv(log := tmp_path / "begin.csv", index=False)
    by_table, by_file = (servofd.explain(each, surface="elevator", servo="hs225bb-eq31") for each in (table, log))
    assert by_table.answer == by_file.answer
    with pytest.raises(TypeError, match=r"a log is a path, .* and not of type int"):
        servofd.identify([3])  # type: ignore[arg-type]
    with pytest.raises(NoMeasurement, match="no log was named"):
        servofd.calibrate([])


@pytest.mark.slow
def test_a_trend_draws_one_surface() -> None:
    seen = servofd.trend(ROOT / "sample_logs" / "faser_healthy_flight.mat", "faser", surfaces=("rudder",), workers=0)
    assert len(seen.plot().axes) == len(seen.to_pandas())
    with pytest.raises(UnknownName, match="unknown surface 'flap'"):
        seen.plot("flap")


@pytest.mark.nightly
def test_a_calibration_tells_what_it_would_show(tmp_path: Path) -> None:
    good = tmp_path / "good.bin"
    assert main(["simulate", "-o", str(good), "--duration", "60"]) == 0
    found = servofd.calibrate(good, surfaces=("elevator",))
    table = found.to_pandas()
    assert table.smallest_bias_deg.between(0.1, 3.0).all()
    assert table.bandwidth_rad_s.between(10.0, 200.0).all()
    assert "Smallest faults that flights like these show" in found.to_html()


@pytest.mark.slow
def test_an_aircraft_without_feedback_is_calibrated_and_judged_by_its_axes(tmp_path: Path) -> None:
    days = [tmp_path / f"2026-05-0{k + 1}.bin" for k in range(3)]
    for k, day in enumerate(days):
        day.write_bytes(airframe_log(fly_airframe(k, day=k, duration_s=90.0)))
    with pytest.raises(servofd.ServofdError, match=r"`servofd\.calibrate\(days\)\.save") as raised:
        servofd.audit(days[0])
    assert " -" not in str(raised.value)
    found = servofd.calibrate(days)
    assert found.sentence == "Calibrated by the motion of the aircraft: roll, pitch, side"
    for aircraft in (found.aircraft, found.save(tmp_path / "plane.toml")):
        judged = servofd.audit(days[1], aircraft)
        assert judged._ipython_key_completions_() == ["roll", "pitch", "side"]
        assert list(judged["pitch"].series()) == ["expected", "shown", "share", "judged"]


def test_only_two_results_are_compared() -> None:
    with pytest.raises(TypeError, match="and not one of type PosixPath"):
        servofd.compare(STUCK, STUCK)  # type: ignore[arg-type]
