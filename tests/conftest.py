"""Settings of the whole suite."""

from __future__ import annotations

import os

from hypothesis import settings

# Two workers share two cores: threads of the linear algebra library would only get into each other's way.
for library in ("OPENBLAS", "MKL", "OMP"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")

# A build fails because of what was changed, not because of what was drawn this time.
settings.register_profile("ci", derandomize=True)
if os.environ.get("CI"):
    settings.load_profile("ci")
