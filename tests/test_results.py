"""Results for a notebook: short, complete, and told from the same numbers as everything else."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path

import pandas as pd
import pytest

import servofd
from logparsers import LogError
from servofd.cli import main
from servofd.core.errors import NoMeasurement, UnknownName

ROOT = Path(__file__).parent.parent
STUCK = ROOT / "sample_logs" / "faser_stuck_flight.mat"


@pytest.fixture(scope="module")
def stuck() -> servofd.Audit:
    found = servofd.audit(STUCK, surfaces=("elevator", "rudder"))
    assert isinstance(found, servofd.Audit)
    return found


@pytest.mark.slow
def test_the_page_on_python_runs_and_prints_what_it_shows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    page = (ROOT / "docs" / "api.md").read_text()
    known: dict[str, object] = {}
    for code, shown in re.findall(r"```python\n(.*?)```\n\n```text\n(.*?)```", page, re.DOTALL):
        output = io.StringIO()
        with contextlib.redirect_stdout(output):
            exec(compile(code, "api.md", "exec"), known)  # noqa: S102 - our own page
        assert output.getvalue() == shown


def test_a_result_is_short_and_a_loop_over_it_gives_itself(stuck: servofd.Audit) -> None:
    assert [one for one in stuck] == [stuck]  # noqa: C416 - as people write it
    assert stuck[0] is stuck
    with pytest.raises(IndexError):
        stuck[1]
    assert len(repr(stuck)) < 400
    assert repr(stuck).count("\n") == 2


@pytest.mark.slow
def test_a_cell_is_escaped_and_needs_nothing(tmp_path: Path) -> None:
    table = pd.read_csv(ROOT / "sample_logs" / "table_three_faults.csv")
    name = "<script>alert(1)</script>"
    renamed = table.rename(columns=lambda column: column.replace("elevator", name))
    found = servofd.audit(renamed, surfaces=(name,))
    assert isinstance(found, servofd.Audit)
    for text in (found._repr_html_(), found.save_html(tmp_path / "a.html").read_text()):
        assert "<script>alert" not in text
        assert "&lt;script&gt;alert" in text
    assert not re.search(r"(src|href)=", found._repr_html_())


@pytest.mark.slow
def test_a_table_is_judged_as_its_file() -> None:
    path = ROOT / "sample_logs" / "table_three_faults.csv"
    table = pd.read_csv(path)
    of_file = servofd.audit(path)
    for given in (table, table.set_index("time_s")):
        of_table = servofd.audit(given)
        assert isinstance(of_table, servofd.Audit)
        assert isinstance(of_file, servofd.Audit)
        pd.testing.assert_frame_equal(of_table.to_pandas(), of_file.to_pandas())


@pytest.mark.slow
def test_runs_come_one_after_the_other(tmp_path: Path) -> None:
    table = pd.read_csv(ROOT / "sample_logs" / "table_three_faults.csv")
    twice = pd.concat([table.assign(run="first"), table.assign(run="second")])
    found = servofd.audit(twice, servo="hs225bb-eq31", surfaces=("rudder",))
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
    with pytest.raises(TypeError, match="a log is a path or a DataFrame, and not of type int"):
        servofd.audit(3)  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_table_is_called_what_it_is() -> None:
    table = pd.read_csv(ROOT / "sample_logs" / "table_three_faults.csv")
    assert repr(servofd.audit(table, surfaces=("aileron",))).splitlines()[0].endswith("(DataFrame, table, 40.0 s)")
    with pytest.raises(LogError, match=r"^DataFrame: "):
        servofd.audit(table[["elevator_cmd_deg"]])


@pytest.mark.slow
def test_a_table_is_a_log_for_every_verb_of_one_flight() -> None:
    log = ROOT / "sample_logs" / "hidden" / "hidden_07.csv"
    explained = servofd.explain(pd.read_csv(log), surface="elevator")
    assert explained.answer == servofd.explain(log, surface="elevator").answer
    with pytest.raises(TypeError, match="a log is a path or a DataFrame, and not of type int"):
        servofd.identify([3])  # type: ignore[arg-type]
    with pytest.raises(NoMeasurement, match="no log was named"):
        servofd.calibrate([])


def test_a_trend_draws_one_surface() -> None:
    seen = servofd.trend(ROOT / "sample_logs" / "faser_healthy_flight.mat", "faser", surfaces=("rudder",), workers=0)
    assert len(seen.plot().axes) == len(seen.to_pandas())
    with pytest.raises(UnknownName, match="unknown surface 'flap'"):
        seen.plot("flap")


@pytest.mark.slow
def test_a_calibration_draws_and_tells_what_it_would_show(tmp_path: Path) -> None:
    good = tmp_path / "good.bin"
    assert main(["simulate", "-o", str(good), "--duration", "120"]) == 0
    found = servofd.calibrate(good)
    table = found.to_pandas()
    assert table.smallest_bias_deg.between(0.1, 3.0).all()
    assert table.bandwidth_rad_s.between(10.0, 200.0).all()
    angles, shares = found.plot().axes
    assert [bars.get_label() for bars in angles.containers] == ["offset", "play", "oscillation"]
    assert [bar.get_width() for bar in shares.containers[0]] == pytest.approx(100.0 * table.smallest_loss_share)
    assert "Smallest faults that flights like these show" in found.to_html()
