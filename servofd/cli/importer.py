"""``rerun-importer-servofd``: lets ``rerun flight.bin`` open a finished recording of servofd.

The viewer calls every program of that kind on its path for every file that it opens; what is no log of an aircraft
with measured surfaces is left to the others.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.detection.verdict import LogAudit

NOT_MINE = 66
"""Rerun's ``EXTERNAL_IMPORTER_INCOMPATIBLE_EXIT_CODE``."""

_ALWAYS_LOGS = (".bin", ".tlog", ".ulg", ".px4log")
_SOMETIMES_LOGS = (".csv", ".mat", ".log", ".h5")


def main(arguments: Sequence[str] | None = None) -> int:
    """Audit a log and send its recording to the viewer that asked for it.

    Parameters
    ----------
    arguments : sequence of str, optional
        Words after the program's name; those of the process if left out.

    Returns
    -------
    int
        0: done; `NOT_MINE`: a file for another reader; 1: a log, but one that cannot be judged (stderr says why).

    Examples
    --------
    >>> main(["holiday.jpg"])
    66
    """
    parser = argparse.ArgumentParser(prog="rerun-importer-servofd", description=__doc__)
    parser.add_argument("file", help="the file that the viewer opens")
    parser.add_argument("--application-id", help="application the viewer wants it under")
    parser.add_argument("--recording-id", help="recording the viewer wants it in")
    options, _unused = parser.parse_known_args(arguments)
    path = Path(options.file)
    suffix = path.suffix.lower()
    if suffix not in (*_ALWAYS_LOGS, *_SOMETIMES_LOGS) or not path.is_file():
        return NOT_MINE
    # Only now: these imports take a second, and the viewer asks for every picture that it opens.
    from logparsers import LogError
    from servofd.cli.terminal import complain
    from servofd.core.errors import ServofdError
    from servofd.jobs.workflow import audit

    try:
        found = next(audit(path))
    except (LogError, ServofdError) as error:
        if suffix in _SOMETIMES_LOGS:
            return NOT_MINE
        complain(error)
        return 1
    _send(found, options)
    return 0


def _send(found: LogAudit, options: argparse.Namespace) -> None:
    from servofd.outputs.recording.write import recording_of, send_to_stdout

    send_to_stdout(recording_of(found), options.application_id, options.recording_id)


if __name__ == "__main__":
    sys.exit(main())
