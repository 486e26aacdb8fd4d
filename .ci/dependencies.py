"""Known vulnerabilities of what is installed: ``python .ci/dependencies.py AUDITOR SITE_PACKAGES``.

Runs pip-audit, and reads what it found instead of its exit code: it says "no known vulnerabilities" as well where its
database could not be asked. Exit code 1: a release without a known vulnerability is to be had; 0: none is known, or
nobody could be asked, which is said.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

__all__ = ["verdict"]


def verdict(report: dict[str, Any]) -> tuple[int, list[str]]:
    """Exit code, and lines to print, for a report of pip-audit.

    Examples
    --------
    >>> verdict({"dependencies": [{"name": "a", "skip_reason": "not found"}]})
    (0, ['dependencies: not checked, the database could not be asked about any of 1'])
    >>> found = {"id": "PYSEC-1", "fix_versions": ["2.0"]}
    >>> verdict({"dependencies": [{"name": "a", "version": "1.0", "vulns": [found]}]})
    (1, ['a 1.0: PYSEC-1, repaired in 2.0', 'dependencies: 1 of 1 checked'])
    """
    entries = report["dependencies"]
    checked = [entry for entry in entries if "vulns" in entry]
    if not checked:
        return 0, [f"dependencies: not checked, the database could not be asked about any of {len(entries)}"]
    lines, code = [], 0
    for entry in checked:
        for found in entry["vulns"]:
            repaired = ", ".join(found["fix_versions"])
            code = 1 if repaired else code
            lines.append(
                f"{entry['name']} {entry['version']}: {found['id']}, repaired in {repaired or 'no release yet'}"
            )
    return code, [*lines, f"dependencies: {len(checked)} of {len(entries)} checked"]


def main(auditor: str, site_packages: str) -> int:
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        options = ["--progress-spinner", "off", "--format", "json", "--output", str(report)]
        try:
            subprocess.run([auditor, "--path", site_packages, *options], capture_output=True, timeout=300, check=False)
            code, lines = verdict(json.loads(report.read_text()))
        except (OSError, subprocess.TimeoutExpired):  # no auditor, no answer, no report
            code, lines = 0, ["dependencies: not checked, pip-audit gave no answer"]
    print("\n".join(lines))
    return code


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
