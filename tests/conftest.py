"""Settings of the whole suite."""

from __future__ import annotations

import os
import signal

from hypothesis import settings

# Two workers share two cores: threads of the linear algebra library would only get into each other's way.
for library in ("OPENBLAS", "MKL", "OMP"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")

# A suite that was started in the background ignores Ctrl-C, and so would the programs that it starts and interrupts.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Nothing fails for being slow: the first example may have to compile what it calls.
settings.register_profile("here", deadline=None)
# A build fails because of what was changed, not because of what was drawn this time.
settings.register_profile("ci", deadline=None, derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "here")
