"""Ctrl-C and termination, so that either ends a run cleanly wherever it strikes."""

from __future__ import annotations

import _thread
import signal
import sys
import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

_AGAIN_S = 0.01


@contextmanager
def interruptible() -> Iterator[None]:
    """Within the block, a termination raises `KeyboardInterrupt` like Ctrl-C, and no interrupt gets lost.

    Python ignores an exception that strikes inside a finaliser or a weak reference's callback: the run would go
    on, with a traceback on the screen. Such an interrupt is raised once more, a moment later.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    terminate, unraisable = signal.getsignal(signal.SIGTERM), sys.unraisablehook

    def ignored(event: sys.UnraisableHookArgs) -> None:
        if issubclass(event.exc_type, KeyboardInterrupt):
            # Not from here: this hook may not raise either.
            threading.Timer(_AGAIN_S, _thread.interrupt_main).start()
        else:
            unraisable(event)

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    sys.unraisablehook = ignored
    try:
        yield
    finally:
        sys.unraisablehook = unraisable
        signal.signal(signal.SIGTERM, terminate)
