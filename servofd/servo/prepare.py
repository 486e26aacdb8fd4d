"""Compiling ahead: what a fresh machine compiles once is compiled by another process, while this one reads the log."""

from __future__ import annotations

import subprocess
import sys
from typing import TYPE_CHECKING

from servofd.servo.generate import is_compiling, is_kept, mark_kept, path_of, wait_for

if TYPE_CHECKING:
    from collections.abc import Callable

_ONCE = "preparing, once: compiling the servo's simulation (some six seconds)"
_KEEP = "from servofd.servo.prepare import keep; keep()"


def compile_ahead(say: Callable[[str], None]) -> None:
    """Have another process compile the stepper, if nothing of it is kept yet, and say so.

    Parameters
    ----------
    say : callable
        Shows a sentence to whoever waits.
    """
    path = None if is_compiling() else path_of()
    if path is None or is_kept(path):
        return
    say(_ONCE)
    nothing = subprocess.DEVNULL
    try:
        wait_for(subprocess.Popen([sys.executable, "-c", _KEEP], stdin=nothing, stdout=nothing, stderr=nothing))  # noqa: S603 - ourselves
    except OSError:  # then this process compiles it where it is needed
        return


def is_prepared() -> bool:
    """Whether nothing has to be compiled any more before a servo is simulated."""
    path = path_of()
    return path is None or is_kept(path)


def keep() -> None:
    """Compile the stepper, and note that its machine code is kept."""
    import numpy as np

    from servofd.servo.motion import machine_of
    from servofd.servo.physics import Physics
    from servofd.servo.transfer import TransferFunction

    machine = machine_of(TransferFunction((1.0,), (1.0, 1.0, 1.0)), (Physics(),))
    machine.run(machine.new_state(), (np.zeros(1), np.zeros(1), np.zeros(1)), np.zeros(1))
    path = path_of()
    if path is not None:
        mark_kept(path)
