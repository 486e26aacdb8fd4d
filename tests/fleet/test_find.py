"""Logs are found by their content, and what is passed over is said."""

from __future__ import annotations

import gzip
import os
from pathlib import Path

import pytest

from logparsers import TableLayout
from servofd.batch.find import META_FILE, find_logs
from servofd.core.errors import ConfigError
from servofd.outputs.document import Document
from servofd.outputs.page import html_page

FLIGHTS = ["broken.csv", "flight0.csv", "flight1.csv", "flight2.csv", "flight3.csv", "flight4.csv"]


def names(*inputs: Path | str) -> list[str]:
    return [Path(log.path).name for log in find_logs([str(one) for one in inputs]).logs]


@pytest.mark.slow
def test_a_folder_gives_its_logs_whatever_they_are_called(logs: Path) -> None:
    found = find_logs([str(logs)])
    assert [Path(log.path).name for log in found.logs] == FLIGHTS
    reasons = {Path(one.path).name: one.reason for one in found.skipped}
    assert set(reasons) == {"README.md", "empty.csv", "noise.bin"}
    assert reasons["README.md"].startswith("no row below the header")
    assert reasons["empty.csv"] == "empty"
    assert "belong to no known format" in reasons["noise.bin"]
    assert all(log.size_bytes == Path(log.path).stat().st_size for log in found.logs)


def test_pages_of_last_time_are_no_flights_and_nothing_is_said_of_them(tmp_path: Path) -> None:
    (tmp_path / "flight.csv").write_text("time_s,rudder_cmd_deg,rudder_pos_deg\n0,1,1\n0.1,2,1\n")
    (tmp_path / "flight.html").write_text(html_page(Document("flight", "healthy", "All is well.")))
    (tmp_path / "other.html").write_text("<!DOCTYPE html><html><body>a page from elsewhere</body></html>")
    found = find_logs([str(tmp_path)])
    assert [Path(log.path).name for log in found.logs] == ["flight.csv"]
    assert [Path(one.path).name for one in found.skipped] == ["other.html"]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
def test_pipes_sockets_and_loops_are_passed_over(tmp_path: Path, logs: Path) -> None:
    os.mkfifo(tmp_path / "pipe")  # opening it would wait for ever
    (tmp_path / "self").symlink_to("self")
    (tmp_path / "up").symlink_to(".")
    (tmp_path / "null").symlink_to(os.devnull)
    (tmp_path / "flight.csv").symlink_to(logs / "flight0.csv")
    found = find_logs([str(tmp_path)])
    assert [Path(log.path).name for log in found.logs] == ["flight.csv"]
    reasons = {Path(one.path).name: one.reason for one in found.skipped}
    assert reasons.keys() == {"pipe", "self", "null"}
    assert "not a regular file" in reasons["pipe"]


def test_archives_are_told_by_what_is_in_them(tmp_path: Path, logs: Path) -> None:
    (tmp_path / "a.csv.gz").write_bytes(gzip.compress((logs / "flight0.csv").read_bytes()))
    (tmp_path / "notes.gz").write_bytes(gzip.compress(b"nothing here\n"))
    (tmp_path / "cut.gz").write_bytes(b"\x1f\x8b\x08")
    found = find_logs([str(tmp_path)])
    assert [Path(log.path).name for log in found.logs] == ["a.csv.gz"]
    assert len(found.skipped) == 2


def test_patterns_folders_and_files_give_no_log_twice(logs: Path) -> None:
    assert names(logs / "**" / "flight[0-3].csv", logs / "may", logs / "flight0.csv") == [
        "flight0.csv",
        "flight1.csv",
        "flight2.csv",
        "flight3.csv",
        "flight4.csv",
    ]


def test_a_named_file_is_taken_whatever_it_is(logs: Path) -> None:
    assert names(logs / "noise.bin", "no_such_file.csv") == ["noise.bin", "no_such_file.csv"]


def test_addresses_are_listed_by_fsspec(logs: Path) -> None:
    fsspec = pytest.importorskip("fsspec")
    memory = fsspec.filesystem("memory")
    memory.pipe("/bucket/a/flight0.csv", (logs / "flight0.csv").read_bytes())
    memory.pipe("/bucket/notes.txt", b"nothing here\n")
    assert [log.path for log in find_logs(["memory://bucket"]).logs] == ["memory:///bucket/a/flight0.csv"]
    assert names("memory://bucket/**/*.csv", f"file://{logs}/may") == ["flight0.csv", "flight3.csv", "flight4.csv"]
    for nothing, why in (
        ("memory://elsewhere", "nothing is there"),
        ("memory://bucket/notes.txt", "holds no log: 1 files passed over"),
        ("nonsense://bucket", "Protocol not known"),
    ):
        with pytest.raises(ConfigError, match=why):
            find_logs([nothing])


def test_a_table_without_names_is_found_through_its_layout(tmp_path: Path) -> None:
    (tmp_path / "bench.txt").write_text("1\t2\n3\t4\n")
    with pytest.raises(ConfigError, match="holds no log"):
        find_logs([str(tmp_path)])
    assert len(find_logs([str(tmp_path)], TableLayout(columns=("cmd", "pos"), sample_rate_hz=100.0)).logs) == 1


@pytest.mark.parametrize(
    ("kind", "why"), [("folder", "this folder holds no file"), ("pattern", "no file fits this pattern")]
)
def test_nothing_to_do_is_an_error_in_one_line(tmp_path: Path, kind: str, why: str) -> None:
    with pytest.raises(ConfigError, match=why) as caught:
        find_logs([str(tmp_path if kind == "folder" else tmp_path / "*.bin")])
    assert "\n" not in str(caught.value)


def test_an_input_without_logs_does_not_stop_the_others(logs: Path, tmp_path: Path) -> None:
    found = find_logs([str(tmp_path), str(logs / "may")])
    assert len(found.logs) == 2
    assert found.problems == (f"{tmp_path}: this folder holds no file; give one that holds flight logs",)


def test_a_folder_of_results_is_no_folder_of_logs(logs: Path, tmp_path: Path) -> None:
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / META_FILE).write_text("{}")
    (tmp_path / "results" / "flight.csv").write_bytes((logs / "flight0.csv").read_bytes())
    with pytest.raises(ConfigError, match="holds no file"):
        find_logs([str(tmp_path)])


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="nothing is forbidden to root")
def test_a_folder_that_may_not_be_read_is_told(tmp_path: Path) -> None:
    (tmp_path / "closed").mkdir(mode=0)
    with pytest.raises(ConfigError, match="cannot read this folder: Permission denied"):
        find_logs([str(tmp_path)])
