"""Where it runs: any locale, homes that cannot be written, strict interpreters, growing logs, systems without POSIX."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import threading
import time
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SAMPLE = ROOT / "sample_logs" / "table_three_faults.csv"
POSIX_ONLY = {
    "fcntl",
    "grp",
    "pwd",
    "termios",
    "tty",
    "pty",
    "resource",
    "syslog",
    "crypt",
    "os.fork",
    "os.getuid",
    "os.geteuid",
    "os.getpgid",
    "os.setsid",
    "os.killpg",
    "os.mkfifo",
    "os.uname",
    "os.getloadavg",
    "os.chown",
    "os.sysconf",
    "signal.SIGHUP",
    "signal.SIGKILL",
    "signal.SIGALRM",
    "signal.SIGPIPE",
    "signal.setitimer",
    "socket.AF_UNIX",
    "socket.SO_REUSEPORT",
}
"""What Windows does not have."""
GUARDED = (ast.Try, ast.If, ast.IfExp, ast.With)


def audited(*words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """`servofd audit` of a surface of a table in a process of its own."""
    return subprocess.run(
        [sys.executable, *words, "-m", "servofd", "audit", str(SAMPLE), "-s", "elevator", "--servo", "hs225bb-eq31"],
        env={**os.environ, "PYTHONIOENCODING": "", **environment},
        capture_output=True,
        text=True,
        encoding="utf-8",
        errors="replace",
        timeout=300,
        check=False,
    )


def words(text: str) -> list[str]:
    """Without the lines around them, which are plain where a terminal knows no others."""
    return re.findall(r"[\w.]+", text)


@pytest.fixture(scope="module")
def usual() -> str:
    """What an interpreter prints for which a warning is an error."""
    found = audited("-W", "error", LC_ALL="C.UTF-8")
    assert found.returncode == 1, found.stderr
    return found.stdout


@cache
def sources(package: str) -> dict[str, ast.Module]:
    """Modules of a package, by their paths."""
    paths = sorted((ROOT / package).rglob("*.py"))
    return {str(path.relative_to(ROOT)): ast.parse(path.read_text(encoding="utf-8")) for path in paths}


@pytest.mark.slow
@pytest.mark.parametrize(
    "locale",
    ["tr_TR.UTF-8", *(pytest.param(name, marks=pytest.mark.nightly) for name in ("C", "POSIX", "xx_XX.none", ""))],
)
def test_every_locale_gives_the_same_numbers_and_no_warning_is_raised_on_the_way(usual: str, locale: str) -> None:
    found = audited(LC_ALL=locale, LANG=locale, PYTHONUTF8="0")
    assert found.returncode == 1, found.stderr
    assert words(found.stdout) == words(usual)
    assert "stuck" in words(usual)
    assert "Traceback" not in found.stderr


@pytest.mark.nightly
def test_a_home_that_cannot_be_written_costs_nothing_but_time(tmp_path: Path) -> None:
    """That of compiling all kernels, which nobody can keep."""
    home = tmp_path / "no-such-home" / "file"
    home.parent.mkdir()
    home.write_text("a file, so that no folder can be made below it")
    places = dict.fromkeys(("HOME", "USERPROFILE", "XDG_CACHE_HOME", "XDG_CONFIG_HOME", "MPLCONFIGDIR"), str(home))
    found = audited(**places)
    assert found.returncode == 1, found.stderr
    assert "Traceback" not in found.stderr


@pytest.mark.slow
def test_a_log_that_grows_while_it_is_read_is_read_as_far_as_it_was(tmp_path: Path) -> None:
    import logparsers

    log, stop = tmp_path / "flight.bin", threading.Event()
    content = (ROOT / "sample_logs" / "ardupilot_volz_stuck.bin").read_bytes()
    log.write_bytes(content[: len(content) // 2])

    def grow() -> None:
        at = len(content) // 2
        with log.open("ab") as out:
            while not stop.is_set() and at < len(content):
                at += out.write(content[at : at + 997])
                out.flush()
                time.sleep(0.001)

    thread = threading.Thread(target=grow)
    thread.start()
    try:
        lengths = [logparsers.read(log).duration_s for _ in range(3)]
    finally:
        stop.set()
        thread.join()
    log.write_bytes(content)
    assert lengths == sorted(lengths)
    assert 0.0 < lengths[0] <= logparsers.read(log).duration_s


def posix_only(tree: ast.AST) -> list[tuple[int, str]]:
    """Lines that use what only POSIX has, outside functions that ask for it first."""
    found = []
    guarded = {id(node) for block in ast.walk(tree) if isinstance(block, GUARDED) for node in ast.walk(block)}
    for node in ast.walk(tree):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            names = [f"{node.value.id}.{node.attr}"]
        line = getattr(node, "lineno", 0)
        found += [(line, name) for name in names if name in POSIX_ONLY and id(node) not in guarded]
    return found


def test_posix_only_calls_are_seen() -> None:
    assert posix_only(ast.parse("import fcntl\nos.getuid()")) == [(1, "fcntl"), (2, "os.getuid")]
    assert posix_only(ast.parse("try:\n    import fcntl\nexcept ImportError:\n    pass")) == []


@pytest.mark.slow
@pytest.mark.parametrize("package", ["logparsers", "servofd"])
def test_no_posix_only_call_outside_guarded_places(package: str) -> None:
    assert {path: calls for path, tree in sources(package).items() if (calls := posix_only(tree))} == {}


@pytest.mark.slow
def test_every_text_file_is_opened_with_its_encoding() -> None:
    """Windows takes another one than UTF-8 where nothing is said."""
    found = []
    for package in ("logparsers", "servofd"):
        for path, tree in sources(package).items():
            for node in ast.walk(tree):
                if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
                    continue
                known = {word.arg for word in node.keywords}
                if node.func.attr in ("read_text", "write_text") and "encoding" not in known and len(node.args) < 2:
                    found.append((path, node.lineno, node.func.attr))
    assert found == []
