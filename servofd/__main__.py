"""``servofd`` and ``python -m servofd``: what begins before anything that takes time to load."""

import os
import signal
import sys
from types import FrameType

_INTERRUPTED = 128 + signal.SIGINT
"""Exit code of a program that Ctrl-C ended, as shells give it."""


def _tell() -> None:
    sys.stderr.write("servofd: interrupted before anything was begun\n")
    sys.stderr.flush()


def _leave(_number: int, _frame: FrameType | None) -> None:
    """End at once: an exception would be lost in a callback of the import, and the run would go on."""
    _tell()
    os._exit(_INTERRUPTED)


def main() -> int:
    """Run one verb and return its exit code; an interrupt while the program loads, or ends, is no traceback."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        # What is ignored stays so: by nohup, or by a shell for what it runs beside itself.
        if number is not None and signal.getsignal(number) in {signal.SIG_DFL, signal.default_int_handler}:
            signal.signal(number, _leave)
    try:
        from servofd.cli import main as program

        code = program()
    except KeyboardInterrupt:
        _tell()
        code = _INTERRUPTED
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # threads that end do not tell of it
    return code


if __name__ == "__main__":
    raise SystemExit(main())
