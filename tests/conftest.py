"""Settings of the whole suite."""

from __future__ import annotations

import os

# Two workers share two cores: threads of the linear algebra library would only get into each other's way.
for library in ("OPENBLAS", "MKL", "OMP"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")
