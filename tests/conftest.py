"""Settings of the whole suite."""

from __future__ import annotations

import os
import signal

import pytest
from hypothesis import settings

# Two workers share two cores: threads of the linear algebra library would only get into each other's way.
for library in ("OPENBLAS", "MKL", "OMP"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")

# Programs that the tests start would compile all that they import, each time anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# A suite that was started in the background ignores Ctrl-C, and so would the programs that it starts and interrupts.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Nothing fails for being slow: the first example may have to compile what it calls.
settings.register_profile("here", deadline=None)
# A build fails because of what was changed, not because of what was drawn this time.
settings.register_profile("ci", deadline=None, derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "here")


_SLOW_EXAMPLES = {
    "servofd.calibrating.calibrate.calibrate_aircraft",
    "servofd.cli.main",
    "servofd.detection.audit.audit_log",
    "servofd.detection.monitor.SurfaceMonitor",
    "servofd.discrepancy.explanation.explain_gap",
    "servofd.fleets.run.audit_fleet",
    "servofd.identification.identify.identify",
    "servofd.jobs.bench.identify",
    "servofd.jobs.workflow.calibrate",
    "servofd.results.audits.audit",
    "servofd.results.audits.compare",
    "servofd.results.audits.fleet",
    "servofd.results.models.explain",
    "servofd.servo.transfer.TransferFunction.to_control",
    "servofd.wear.trend.trend_logs",
}
"""Examples in docstrings that fit, search or start processes: as slow as the tests that do."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Campaigns, leaks and pictures run when they are asked for: ``pytest -m nightly``."""
    for item in items:
        if item.name in _SLOW_EXAMPLES:
            item.add_marker(pytest.mark.slow)
    if "nightly" in config.option.markexpr:
        return
    nightly = [item for item in items if item.get_closest_marker("nightly")]
    if nightly:
        config.hook.pytest_deselected(items=nightly)
        items[:] = [item for item in items if not item.get_closest_marker("nightly")]
