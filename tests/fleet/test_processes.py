"""The real thing: processes of this machine, death and interrupts."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from servofd.batch.find import find_logs
from servofd.batch.key import Job
from servofd.fleets.run import audit_fleet
from servofd.fleets.store import TABLES, rows

if TYPE_CHECKING:
    pass

pytestmark = pytest.mark.slow

_MAIN = (
    "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler);"
    "from servofd.cli import main; sys.exit(main(sys.argv[1:]))"
)
"""Whoever starts the tests in the background has interrupts ignored, and that is inherited."""
KNOWN = ("--servo", "hs225bb-eq31")
ROOT = Path(__file__).parent.parent.parent


def tables(logs: Path) -> dict[str, list[str]]:
    """Every row of every table, in an order of its own."""
    merged: dict[str, list[str]] = {name: [] for name in TABLES}
    for judged in audit_fleet(find_logs([str(logs)]).logs, Job()):
        for name, content in rows(judged).items():
            merged[name] += [json.dumps(row, sort_keys=True, default=str) for row in content]
    return {name: sorted(content) for name, content in merged.items()}


@pytest.fixture(scope="module")
def expected(logs: Path) -> dict[str, list[str]]:
    found = tables(logs)
    assert len(found["logs"]) == 6
    return found


@pytest.mark.parametrize("end", [signal.SIGINT, pytest.param(signal.SIGKILL, marks=pytest.mark.nightly)])
def test_an_end_in_the_middle_keeps_what_was_done_and_the_next_run_goes_on(
    end: signal.Signals, logs: Path, tmp_path: Path
) -> None:
    many = tmp_path / "many"
    many.mkdir()
    for k in range(5):  # a blank line more each: other bytes, the same flight
        (many / f"flight{k}.csv").write_bytes((logs / "flight0.csv").read_bytes() + b"\n" * k)
    at_once = (
        "import servofd.fleets.store; servofd.fleets.store._SECONDS_PER_PART = 0.0\n" if end == signal.SIGKILL else ""
    )
    command = [sys.executable, "-c", at_once + _MAIN, "audit", str(many), *KNOWN, "-o", str(tmp_path / "r")]
    command += ["--workers", "1"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment, start_new_session=True
    )
    # The page of the second flight is written when the first flight is kept.
    shown, enough = ("logs/part-*.parquet", 1) if end == signal.SIGKILL else ("flight*.html", 2)
    while len(list((tmp_path / "r").glob(shown))) < enough:
        time.sleep(0.05)
    os.killpg(process.pid, end)  # as a terminal does: to the processes as well
    _, err = process.communicate(timeout=300)
    assert "Traceback" not in err
    if end == signal.SIGINT:
        assert process.returncode == 130
        assert err.splitlines()[-1] == "servofd: interrupted; nothing half-written was left behind"
    again = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert again.returncode == 0
    assert "of 5 logs are done already" in again.stderr
    assert "of 5 judged logs" in again.stdout


def test_a_log_that_kills_its_process_is_given_up_and_the_others_are_judged(logs: Path, tmp_path: Path) -> None:
    """The reader of one log is made to die as the system ends a process that takes too much memory."""
    two = tmp_path / "two"
    two.mkdir()
    for name in ("flight0.csv", "flight1.csv"):
        (two / name).symlink_to(logs / name)
    (tmp_path / "sitecustomize.py").write_text(
        "import os, sys\n"
        "def hook(event, args):\n"
        "    if event == 'open' and str(args[0]).endswith('flight0.csv') and 'spawn_main' in ' '.join(sys.orig_argv):\n"
        "        os.kill(os.getpid(), 9)\n"
        "sys.addaudithook(hook)\n"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])}
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "servofd",
            "audit",
            str(two),
            *KNOWN,
            "--workers",
            "1",
            "--json",
            str(tmp_path / "out.json"),
        ],
        capture_output=True,
        text=True,
        env=environment,
        check=False,
    )
    assert done.returncode == 2
    assert f"servofd: {two}/flight0.csv: the process that read it died: out of memory, killed or crashed" in done.stderr
    document = json.loads((tmp_path / "out.json").read_text())
    assert [Path(log["path"]).name for log in document["logs"] if log["error"] is None] == ["flight1.csv"]
    assert len(document["logs"]) == 2


def test_a_script_needs_no_guard_and_is_not_run_again(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text("from servofd.batch.local import run_local\nprint(sorted(run_local(abs, [-1, 2], workers=2)))\n")
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("[(-1, 1), (2, 2)]\n", "")
