"""An interrupt ends a run wherever it strikes."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

import pytest

from servofd.__main__ import main
from servofd.cli import interruptible


class Finaliser:
    """Something whose finaliser is struck by Ctrl-C."""

    def __del__(self) -> None:
        raise KeyboardInterrupt


def struck_and_waiting() -> None:
    """Five seconds at most; the interrupt comes again after a hundredth of one."""
    Finaliser()
    for _ in range(500):
        time.sleep(0.01)


def test_an_interrupt_inside_a_finaliser_is_not_lost() -> None:
    hook = sys.unraisablehook
    with pytest.raises(KeyboardInterrupt), interruptible():
        struck_and_waiting()
    assert sys.unraisablehook is hook


def test_a_termination_is_an_interrupt_and_the_old_handler_comes_back() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt), interruptible():
        signal.raise_signal(signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) is before


def test_an_interrupt_while_a_compiled_module_loads_is_no_import_error() -> None:
    def load() -> None:
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise ImportError("PyCapsule_Import could not import module") from None

    with pytest.raises(KeyboardInterrupt), interruptible():
        load()


def test_an_interrupt_while_the_program_loads_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def strike() -> int:
        raise KeyboardInterrupt

    before = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr("servofd.cli.main", strike)
    try:
        assert main() == 130
    finally:
        signal.signal(signal.SIGINT, before)
    assert capsys.readouterr().err.count("\n") == 1


def test_an_interrupt_inside_a_callback_while_the_program_loads_is_not_lost() -> None:
    """As in the callback that lets go of a module's lock: what it raises is ignored."""
    loads = """
import signal, servofd.cli, servofd.__main__
class Lock:
    def __del__(self):
        signal.raise_signal(signal.SIGINT)
def load():
    Lock()
    return 0
servofd.cli.main = load
raise SystemExit(servofd.__main__.main())
"""
    ended = subprocess.run([sys.executable, "-c", loads], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (130, "servofd: interrupted before anything was begun\n")
