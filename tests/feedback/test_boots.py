"""Two boots in one file are two flights."""

from __future__ import annotations

from typing import TYPE_CHECKING

import servofd
from servofd.cli import main

if TYPE_CHECKING:
    from pathlib import Path


def test_no_fault_spans_a_reboot_and_each_boot_is_judged_on_its_own(tmp_path: Path) -> None:
    parts = []
    for name, fault in (("first", ["--fault", "rudder:stuck@25"]), ("second", [])):
        path = tmp_path / f"{name}.bin"
        assert main(["simulate", "-o", str(path), "--duration", "40", *fault]) == 0
        parts.append(path.read_bytes())
    both = tmp_path / "both.bin"
    both.write_bytes(parts[0] + parts[1])
    first, second = servofd.audit(both)
    assert (first.log.run, second.log.run) == ("boot 1", "boot 2")
    for result in (first, second):
        for surface in result.surfaces:
            assert surface.residuals is not None
            assert surface.judged_share > 0.9
            assert surface.residuals.time_s[-1] - surface.residuals.time_s[0] < 41.0
    assert [s.surface for s in first.surfaces if s.status == "fault"] == ["rudder"]
    assert not second.has_fault
    assert main(["audit", str(both)]) == 1
