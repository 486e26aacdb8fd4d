"""Every verb in a real terminal, whose screen is read: no code stands on it as text, whatever its width."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import pytest

from servofd.cli import main
from servofd.servo.faults import Stuck
from servofd.simulation.telemetry_writer import telemetry_log
from tests.cli.test_calibrate import flown as table_flight
from tests.cli.test_calibrate import logged
from tests.fleet.conftest import in_line
from tests.live.vehicles import PLANE, flown, plane_file
from tests.recovery.fine_servo import FineServo, hide
from tests.terminal.terminals import Terminal

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason="has no pseudo-terminals")]

WIDTHS = (60, *(pytest.param(width, marks=pytest.mark.nightly) for width in (100, 200)))
"""Most is folded in the narrowest."""
_CODE = re.compile(r"\\x1b|\\x9b|\[\d+(;\d+)*m|\[\?\d+[hl]")
"""A code that did not act."""
_REFRESHED = b"\x1b[H"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flight for the monitor, two for the audit of a folder, and one with a gap to explain."""
    path: Path = tmp_path_factory.mktemp("terminal")
    flight = flown(duration_s=40.0, command="gusty", faults={"elevator": Stuck(5.0)})
    (path / "flight.tlog").write_bytes(telemetry_log(flight, PLANE))
    short = flown(duration_s=16.0, command="gusty", faults={"elevator": Stuck(5.0)})
    (path / "short.tlog").write_bytes(telemetry_log(short, PLANE))
    (path / "plane.toml").write_text(plane_file())
    (path / "logs").mkdir()
    logged(path / "logs", "good.csv", table_flight())
    logged(path / "logs", "jammed.csv", table_flight(seed=2, faults={"rudder": Stuck(12.0)}))
    hide(FineServo(delay_s=0.03), duration_s=12.0).write(path / "gap.csv")
    return path


def clean(shown: list[str], width: int) -> str:
    """What stands there as one text; nothing of it is a code, and nothing goes over the edge."""
    text = "\n".join(shown)
    assert not _CODE.findall(text), text
    assert "Traceback" not in text
    assert max(map(len, shown)) <= width
    return " ".join(text.split())


def printed(words: list[str], width: int, monkeypatch: pytest.MonkeyPatch) -> tuple[int, str]:
    """Exit code of a verb, and what it leaves on a terminal of this width."""
    with Terminal(width) as terminal:
        monkeypatch.setenv("TERM", "xterm-256color")
        for name in ("COLUMNS", "LINES"):
            monkeypatch.delenv(name, raising=False)
        with terminal.open() as stream:
            for name in ("stdout", "stderr"):
                monkeypatch.setattr(sys, name, stream)
            code = main(words)
            monkeypatch.undo()
        return code, clean(terminal.look(), width)


@pytest.mark.parametrize("width", WIDTHS)
def test_what_verbs_print(folder: Path, width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("servofd.fleets.run.run_local", in_line)
        code, shown = printed(["audit", str(folder / "logs"), "--servo", "hs225bb-eq31"], width, monkeypatch)
    assert (code, "JAMMED" in shown, "healthy" in shown) == (1, True, True)
    target = str(folder / f"calibrated{width}.toml")
    code, shown = printed(["calibrate", str(folder / "logs" / "good.csv"), "-o", target], width, monkeypatch)
    assert (code, "Calibrated: rudder" in shown) == (0, True)
    code, shown = printed(["explain", str(folder / "gap.csv"), "--servo", "hs225bb-eq31"], width, monkeypatch)
    assert (code, "delay" in shown) == (0, True)


@pytest.mark.parametrize("width", WIDTHS)
def test_the_local_page(folder: Path, width: int) -> None:
    with Terminal(width) as terminal:
        server = terminal.run(["serve", "--port", "0", "--no-open", "--folder", str(folder / f"served{width}")])
        terminal.wait(lambda shown: "Ctrl-Cendsit" in "".join("".join(shown).split()))  # wherever the line is folded
        assert terminal.end(server, signal.SIGINT) == 0
        assert "http://127.0.0.1:" in clean(terminal.look(), width)


def is_whole(shown: list[str], width: int) -> bool:
    """Whether a picture of this width stands there: each surface once, the vehicle in words, and what to do."""
    text = " ".join(" ".join(shown).split())
    parts = (r"^servofd monitor", r"elevator ALARM", r"rudder watched", "stuck at", "since it booted")
    once = sum(line.startswith("elevator ") for line in shown) == 1
    return once and max(map(len, shown)) <= width and all(re.search(part, text) for part in parts)


def test_the_monitor_in_a_window_that_changes_its_size(folder: Path) -> None:
    """One surface jams: a row says since when, and what to do; Ctrl-C leaves the summary and the exit code."""
    words = ["monitor", str(folder / "flight.tlog"), "-c", str(folder / "plane.toml"), "--speed", "2", "--no-alert"]
    with Terminal(100) as terminal:
        monitor = terminal.run(words)
        terminal.wait(lambda shown: any("land" in line for line in shown))
        for width in (100, 60, 200, 20):
            terminal.resize(width)
            monitor.send_signal(signal.SIGWINCH)
            # A picture of this width, whole, after whatever was on its way.
            clean(terminal.wait(lambda shown, width=width: is_whole(shown, width)), width)  # type: ignore[misc]
        terminal.resize(100)
        code = terminal.end(monitor, signal.SIGINT)
        left = clean(terminal.look(), 100)
    assert code == 1
    assert "elevator: ALARM, stuck at" in left
    assert "aileron: no alarm" in left
    assert "since it booted" not in left  # the picture has gone, and what was there before is back


def test_a_replay_without_a_pause_is_drawn_ten_times_a_second_at_most(folder: Path) -> None:
    words = ["monitor", str(folder / "short.tlog"), "-c", str(folder / "plane.toml"), "--speed", "0", "--no-alert"]
    with Terminal(60) as terminal:
        begun_s = time.monotonic()
        assert terminal.end(terminal.run(words, NO_COLOR="1")) == 1
        assert terminal.raw.count(_REFRESHED) <= 10.0 * (time.monotonic() - begun_s) + 3
        clean(terminal.look(), 60)
        assert not re.search(rb"\x1b\[[\d;]*3[0-7]", terminal.raw)  # no colour


def test_a_terminal_that_cannot_draw_gets_lines(folder: Path) -> None:
    words = ["monitor", str(folder / "short.tlog"), "-c", str(folder / "plane.toml"), "--speed", "0", "--no-alert"]
    with Terminal(100) as terminal:
        assert terminal.end(terminal.run(words, TERM="dumb")) == 1
        assert b"\x1b" not in terminal.raw
        shown = clean(terminal.look(), 100)
    assert "elevator: ALARM, stuck at" in shown
    assert "rudder: watched" in shown


_CLOSED = "servofd: cannot write the result: standard output was closed; what was written to files until then is whole"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_while_the_program_loads_is_one_line(number: signal.Signals) -> None:
    finder = f"def find_spec(self, name, *_): name == 'servofd.cli' and os.kill(os.getpid(), {number.value})"
    code = f"class Slow:\n  {finder}\nsys.meta_path.insert(0, Slow())\nraise SystemExit(main())"
    run = [sys.executable, "-c", f"import os, sys\nfrom servofd.__main__ import main\n{code}"]
    done = subprocess.run(run, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == "servofd: interrupted before anything was begun\n"


@pytest.mark.parametrize("how", ["SIGTERM", pytest.param("SIGHUP", marks=pytest.mark.nightly), "closed"])
def test_whatever_ends_it_the_lines_of_json_are_whole(folder: Path, tmp_path: Path, how: str) -> None:
    lines, own = tmp_path / "events.jsonl", tmp_path / "own.tlog"
    words = ["monitor", str(folder / "flight.tlog"), "-c", str(folder / "plane.toml"), "--speed", "4", "--no-alert"]
    words += ["--plain", "--json-lines", str(lines), "--tlog", str(own)]
    run = [sys.executable, "-m", "servofd", *words]
    with subprocess.Popen(run, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as monitor:
        assert monitor.stdout is not None
        assert any(b"stuck at" in line for line in iter(monitor.stdout.readline, b""))
        if how == "closed":
            monitor.stdout.close()
        else:
            monitor.send_signal(getattr(signal, how))
        said = monitor.stderr.read() if monitor.stderr is not None else b""
        code = monitor.wait()
    assert code == (2 if how == "closed" else 1)
    assert said.decode().splitlines() == [_CLOSED] * (how == "closed")
    events = [json.loads(line) for line in lines.read_text().splitlines()]
    assert {"alarm", "named"} <= {event["event"] for event in events}
    assert (folder / "flight.tlog").read_bytes().startswith(own.read_bytes())
