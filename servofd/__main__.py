"""``servofd`` and ``python -m servofd``: what begins before anything that takes time to load."""

import signal
import sys
from types import FrameType


def _strike(_number: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def main() -> int:
    """Run one verb and return its exit code; an interrupt while the program loads, or ends, is no traceback."""
    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) == signal.SIG_DFL:  # nohup ignores the second
            signal.signal(number, _strike)
    try:
        from servofd.cli import main as program

        code = program()
    except KeyboardInterrupt:
        sys.stderr.write("servofd: interrupted before anything was begun\n")
        code = 128 + signal.SIGINT
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # threads that end do not tell of it
    return code


if __name__ == "__main__":
    raise SystemExit(main())
