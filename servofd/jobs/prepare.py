"""Compiling ahead: what a fresh machine compiles once is compiled by other processes, while this one reads the log."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress

from servofd.estimate.family import EFFECTS
from servofd.servo.generate import compiling, is_kept, mark_kept, path_of

_ONCE = "preparing, once: compiling the servo's simulation (some six seconds)"
_KEEP = "from servofd.jobs.prepare import keep_{0}; keep_{0}()"


def compile_ahead(say: Callable[[str], None]) -> None:
    """Have other processes compile the stepper and the detector's windows, if nothing of it is kept yet, and say so.

    `say`: shows a sentence to whoever waits.
    """
    if compiling or is_prepared():
        return
    say(_ONCE)
    nothing = subprocess.DEVNULL
    for what in ("stepper", "windows"):
        command = [sys.executable, "-c", _KEEP.format(what)]
        with suppress(OSError):  # then this process compiles it where it is needed
            compiling.append(subprocess.Popen(command, stdin=nothing, stdout=nothing, stderr=nothing))  # noqa: S603 - ourselves


def is_prepared() -> bool:
    """Whether nothing has to be compiled any more before a servo is simulated."""
    path = path_of(EFFECTS)
    return path is None or is_kept(path)


def keep_stepper() -> None:
    """Compile the stepper of calibrated servos, and note that its machine code is kept."""
    import numpy as np

    from servofd.aircraft.priors import PRIORS
    from servofd.estimate.family import new_state, simulated, variants

    table = variants(np.array([prior.value for prior in PRIORS]))
    once, command = np.zeros(1), (np.zeros(1), np.zeros(1), np.zeros(1))
    simulated(table, new_state(len(table)), command, once, once, np.ones(1), once)
    path = path_of(EFFECTS)
    if path is not None:
        mark_kept(path)


def keep_windows() -> None:
    """Compile the tests of the detector's windows."""
    import numpy as np

    from servofd.aircraft.calibrated import CalibratedServo, Noise, lower_triangle
    from servofd.aircraft.priors import FITTED, PRIORS
    from servofd.detection.changes import Memory, Tests, follow
    from servofd.estimate.family import PATTERNS

    noise = Noise(still_deg=0.1, lag_s=0.0, colour=(0.0, 0.0), innovation=1.0, period_s=0.02)
    parameters, between = {prior.name: prior.value for prior in PRIORS}, lower_triangle(np.eye(FITTED))
    usual = CalibratedServo(parameters=parameters, between=between, noise=noise, reach_deg=(-20.0, 20.0))
    tests = Tests.of(usual, 0.02)
    slopes = np.zeros((1, FITTED + len(PATTERNS)))
    follow(tests, Memory(tests), np.zeros(1), np.zeros(1), slopes, np.ones(1), np.zeros(1))
