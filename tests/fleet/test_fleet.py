"""Many logs: the same verdicts as one by one, kept in tables, resumed where a run was broken off."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd
import pyarrow.parquet as pq
import pytest

from servofd.batch.find import find_logs
from servofd.batch.key import Job
from servofd.cli import main
from servofd.core.errors import ConfigError
from servofd.fleets.overview import overview
from servofd.fleets.store import FleetStore, locked, read_logs

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

KNOWN = ("--servo", "hs225bb-eq31")
KEYS = ["path", "run", "surface"]


@pytest.fixture(autouse=True)
def judged(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Do the work in this process, which knows servofd already, and remember what was done."""
    done: list[str] = []

    def in_line(task: Callable[[Any], Any], items: Sequence[Any], _workers: int | None) -> Iterator[tuple[Any, Any]]:
        for item in items:
            done.append(item.path)
            yield item, task(item)

    monkeypatch.setattr("servofd.fleets.run.run_local", in_line)
    return done


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    code = main([str(word) for word in words])
    printed = capsys.readouterr()
    return code, printed.out, printed.err


@pytest.mark.slow
def test_a_folder_is_judged_like_its_logs_one_by_one(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = run(
        capsys, "audit", *KNOWN, logs / "may", "-o", tmp_path / "results", "--json", tmp_path / "fleet.json"
    )
    assert code == 1
    sentence, *lines = out.splitlines()
    assert sentence == f"1 of 2 judged logs shows a fault. → {tmp_path}/results/fleet.html"
    assert lines[0].startswith("fault   flight4.csv RUDDER JAMMED at 0:15")
    assert lines[1] == "healthy flight3.csv All 2 surfaces followed their commands."
    assert err == ""
    one_by_one = [str(logs / "may" / f"flight{k}.csv") for k in (3, 4)]
    assert main(["audit", *KNOWN, *one_by_one, "--json", str(tmp_path / "one.json")]) == 1
    assert json.loads((tmp_path / "fleet.json").read_text()) == json.loads((tmp_path / "one.json").read_text())
    page = (tmp_path / "results" / "fleet.html").read_text()
    assert "1 of 2 judged logs shows a fault" in page
    assert str(logs) not in page


@pytest.mark.slow
def test_logs_at_an_address_are_fetched_and_named_by_it(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], judged: list[str]
) -> None:
    memory = pytest.importorskip("fsspec").filesystem("memory")
    memory.pipe("/flights/may.csv", (logs / "may" / "flight4.csv").read_bytes())
    words = ["audit", *KNOWN, "memory://flights", "-o", tmp_path / "r", "--json", tmp_path / "a.json"]
    assert run(capsys, *words)[0] == 1
    assert json.loads((tmp_path / "a.json").read_text())["logs"][0]["path"] == "memory:///flights/may.csv"
    assert run(capsys, *words)[0] == 1
    assert judged == ["memory:///flights/may.csv"]


@pytest.mark.slow
def test_what_could_not_be_judged_is_said_and_the_rest_is_done(
    logs: Path, capsys: pytest.CaptureFixture[str], judged: list[str]
) -> None:
    code, out, err = run(capsys, "audit", *KNOWN, logs)
    assert code == 1
    assert len(judged) == 6
    assert "passed over 3 files that are no logs" in err
    assert [line for line in err.splitlines() if "broken.csv" in line] == [
        f"servofd: {logs}/broken.csv: line 2, column 'elevator_pos_deg': 'x' is not a number; missing cells are empty "
        "or nan"
    ]
    assert out.startswith("1 of 5 judged logs shows a fault, 1 more could not be judged.")
    assert max(map(len, out.splitlines()[1:])) <= 80


@pytest.mark.slow
def test_tables_are_read_by_pandas_and_duckdb(results: Path) -> None:
    surfaces = pd.read_parquet(results / "surfaces")
    assert len(surfaces) == 10
    assert surfaces.groupby("surface").status.value_counts().to_dict() == {
        ("elevator", "healthy"): 5,
        ("rudder", "healthy"): 4,
        ("rudder", "fault"): 1,
    }
    (fault,) = pd.read_parquet(results / "faults").to_dict("records")
    assert (fault["surface"], fault["kind"], fault["level"]) == ("rudder", "stuck", "fault")
    assert fault["start_s"] == pytest.approx(15.0, abs=0.3)
    logs_table = pd.read_parquet(results / "logs")
    assert logs_table.not_judged.notna().sum() == 1
    duckdb = pytest.importorskip("duckdb")
    table = duckdb.read_parquet(f"{results}/surfaces/*.parquet")
    assert table.filter("status = 'fault'").project("surface").fetchall() == [("rudder",)]


@pytest.mark.slow
def test_tables_are_read_by_rerun(of_may: Path) -> None:
    from rerun.experimental import ParquetReader

    (part,) = (of_may / "surfaces").glob("*.parquet")
    assert sum(chunk.num_rows for chunk in ParquetReader(part).stream().to_chunks()) >= 4


@pytest.mark.slow
def test_finished_logs_are_not_done_again(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], judged: list[str]
) -> None:
    mine = tmp_path / "mine"
    shutil.copytree(logs / "may", mine)
    assert run(capsys, "audit", *KNOWN, mine, "-o", tmp_path / "r")[0] == 1
    assert len(judged) == 2
    shutil.copy(logs / "flight0.csv", mine / "new.csv")
    shutil.copy(logs / "may" / "flight3.csv", mine / "a copy of flight3.csv")
    code, out, err = run(capsys, "audit", *KNOWN, mine, "-o", tmp_path / "r")
    assert (code, len(judged)) == (1, 3)
    assert "3 of 4 logs are done already" in err
    assert "1 of 3 judged logs" in out
    assert run(capsys, "fleet", tmp_path / "r")[0] == 1


@pytest.mark.slow
def test_the_same_bytes_twice_in_one_run_count_once(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(logs / "may", tmp_path / "mine")
    shutil.copy(tmp_path / "mine" / "flight3.csv", tmp_path / "mine" / "copy.csv")
    _, out, err = run(capsys, "audit", *KNOWN, tmp_path / "mine", "-o", tmp_path / "r")
    assert "the same bytes as another log; counted once" in err
    assert "1 of 2 judged logs" in out


@pytest.mark.slow
def test_another_threshold_is_another_job_and_the_first_comes_back(
    logs: Path, of_may: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], judged: list[str]
) -> None:
    words = ["audit", logs / "may", "--servo", "hs225bb-eq31", "-o", shutil.copytree(of_may, tmp_path / "r")]
    _, out, err = run(capsys, *words, "--threshold-deg", "3")
    assert "2 logs were judged with another aircraft file, other options or another version" in err
    assert "1 of 2 judged logs" in out
    assert len(judged) == 2
    assert set(pd.read_parquet(tmp_path / "r" / "surfaces").threshold_deg) == {3.0}
    run(capsys, *words)
    assert len(judged) == 2
    assert set(pd.read_parquet(tmp_path / "r" / "surfaces").threshold_deg) == {1.5}


@pytest.mark.slow
def test_another_version_judges_again(
    logs: Path, of_may: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
    judged: list[str],
) -> None:  # fmt: skip
    shutil.copytree(of_may, tmp_path / "r")
    monkeypatch.setattr("servofd.batch.key.__version__", "99.0")
    assert "another version" in run(capsys, "audit", *KNOWN, logs / "may", "-o", tmp_path / "r")[2]
    assert len(judged) == 2


@pytest.mark.slow
def test_an_interrupt_keeps_what_was_done(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, judged: list[str]
) -> None:
    for name in ("flight0.csv", "flight1.csv", "broken.csv"):
        shutil.copy(logs / name, tmp_path)
    real = FleetStore.add

    def struck(store: FleetStore, one: Any) -> bool:
        is_new = real(store, one)
        if len(judged) == 2:
            raise KeyboardInterrupt
        return is_new

    monkeypatch.setattr(FleetStore, "add", struck)
    assert main(["audit", *KNOWN, str(tmp_path), "-o", str(tmp_path / "r")]) == 130
    monkeypatch.setattr(FleetStore, "add", real)
    capsys.readouterr()
    _, _, err = run(capsys, "audit", *KNOWN, tmp_path, "-o", tmp_path / "r")
    assert "2 of 3 logs are done already" in err
    assert len(judged) == 3
    assert len(read_logs(tmp_path / "r")) == 3


@pytest.mark.slow
def test_parts_without_their_logs_are_removed(
    logs: Path, of_may: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(of_may, tmp_path / "r")
    (part,) = (tmp_path / "r" / "logs").glob("*.parquet")
    part.unlink()
    run(capsys, "audit", *KNOWN, logs / "may", "-o", tmp_path / "r")
    assert len(pd.read_parquet(tmp_path / "r" / "surfaces")) == 4


@pytest.mark.slow
def test_a_log_that_could_not_be_read_is_tried_again_and_replaced(
    tmp_path: Path, logs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    late = tmp_path / "late.csv"
    words = ["audit", *KNOWN, late, "--workers", "1", "-o", tmp_path / "r"]
    assert run(capsys, *words)[0] == 2
    shutil.copy(logs / "flight0.csv", late)
    assert run(capsys, *words)[0] == 0
    assert len(pd.read_parquet(tmp_path / "r" / "logs")) == 1


@pytest.mark.parametrize(
    ("content", "why"),
    [
        ('{"schema": "servofd.fleets/9", "job": "x"}', "holds results of the form servofd.fleets/9"),
        ("not json", "is not what servofd writes"),
    ],
)
def test_results_of_another_form_are_refused(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str, why: str
) -> None:
    (tmp_path / "fleet.json").write_text(content)
    for words in (["audit", *KNOWN, logs, "-o", tmp_path], ["fleet", tmp_path]):
        code, out, err = run(capsys, *words)
        assert (code, out) == (2, "")
        assert why in err.splitlines()[-1]


def test_folders_that_are_none_are_refused(logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    for words, why in (
        (["audit", *KNOWN, logs, "-o", tmp_path / "file"], "is a file"),
        (["audit", *KNOWN, logs, "--rrd", tmp_path / "a.rrd"], "--rrd takes one log"),
        (["fleet", tmp_path], "no results of many logs"),
        (["audit", tmp_path / "*.bin"], "no file fits this pattern"),
    ):
        code, _, err = run(capsys, *words)
        assert code == 2
        assert why in err.splitlines()[-1]


@pytest.mark.slow
def test_a_damaged_part_is_named(results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(results, tmp_path / "r")
    part = next((tmp_path / "r" / "logs").glob("*.parquet"))
    part.write_bytes(part.read_bytes()[:100])
    code, _, err = run(capsys, "fleet", tmp_path / "r")
    assert code == 2
    assert "damaged" in err
    assert part.name in err


@pytest.mark.slow
def test_the_overview_counts_what_the_logs_say(results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    seen = overview(read_logs(results))
    assert (seen.logs, seen.statuses, seen.exit_code) == (6, {"not_judged": 1, "healthy": 4, "fault": 1}, 1)
    assert {count["surface"]: count["kinds"] for count in seen.surfaces} == {"elevator": {}, "rudder": {"stuck": 1}}
    code, out, _ = run(capsys, "fleet", results, "--json", "-")
    document = json.loads(out)
    assert (code, document["schema"], len(document["faults"])) == (1, "servofd.fleets/1", 1)


@pytest.mark.slow
def test_a_table_has_the_same_columns_whatever_it_holds(tmp_path: Path, logs: Path) -> None:
    from servofd.fleets.run import judge_log
    from servofd.fleets.store import TABLES

    with FleetStore(tmp_path, Job().key) as store:
        for source in find_logs([str(logs / "flight0.csv"), "no_such.csv"]).logs:
            store.add(judge_log(source, Job()))
            store.flush()
    for name, columns in TABLES.items():
        schemas = {tuple(pq.read_schema(path)) for path in (tmp_path / name).glob("*.parquet")}
        assert len(schemas) == 1
        assert list(columns) == [field.name for field in schemas.pop()]


def test_a_key_depends_on_all_that_decides_a_verdict() -> None:
    from servofd.aircraft.schema import plain_aircraft

    jobs = [
        Job(),
        Job(plain_aircraft(["rudder"], "hs225bb-eq31")),
        Job(servo="s9254"),
        Job(threshold_deg=1.0),
        Job(threshold="interval"),
        Job(surfaces=("rudder",)),
    ]
    assert len({job.key for job in jobs}) == len(jobs)


def test_a_store_refuses_a_folder_with_tables_of_others(tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    pd.DataFrame({"a": [1]}).to_parquet(tmp_path / "logs" / "a.parquet")
    with pytest.raises(ConfigError, match="servofd did not write"):
        FleetStore(tmp_path, "key")


@pytest.mark.slow
def test_only_one_audit_writes_to_a_folder(logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["audit", *KNOWN, logs / "may", "-o", tmp_path]
    with FleetStore(tmp_path, Job().key):
        code, _, err = run(capsys, *words)
    assert code == 2
    assert err == f"servofd: {tmp_path}: another audit writes its results here; wait for it, or choose another folder\n"
    assert not list(tmp_path.glob("*/*.parquet"))
    assert run(capsys, *words)[0] == 1


@pytest.mark.slow
def test_the_lock_of_a_killed_audit_is_free(tmp_path: Path) -> None:
    program = f"""
import pathlib, time
from servofd.fleets.store import locked
file = locked(pathlib.Path({str(tmp_path)!r}))
print("mine", flush=True)
time.sleep(600)
"""
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == b"mine\n"
        with pytest.raises(ConfigError, match="another audit"):
            locked(tmp_path)
        other.kill()
        other.wait(timeout=30)
    locked(tmp_path).close()


@pytest.mark.slow
def test_a_fleet_with_a_log_that_was_not_judged_is_not_green(tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    logs.mkdir()
    shutil.copy(Path(__file__).parents[2] / "sample_logs" / "faser_healthy_flight.mat", logs)
    (logs / "broken.csv").write_text("time_s,elevator_cmd_deg,elevator_pos_deg\n0,x,0\n")
    assert main(["audit", *KNOWN, str(logs), "-o", str(tmp_path / "results")]) == 2
    page = (tmp_path / "results" / "fleet.html").read_text()
    assert '<header class="banner unknown">' in page
    assert "None of 1 judged logs shows a fault, 1 more could not be judged." in page
