"""``servofd view``: look at a log or a recording."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any


def add_parser(verbs: argparse._SubParsersAction[Any]) -> None:
    """Declare the verb."""
    parser = verbs.add_parser(
        "view",
        help="look at a flight in the Rerun viewer",
        description="Audits a log, if it is given one, and opens the Rerun viewer on the recording.",
        epilog="Example: servofd view sample_logs/faser_stuck_flight.mat",
    )
    parser.add_argument("file", metavar="LOG|RECORDING", help="a log that audit reads, or an .rrd file")
    parser.add_argument("-c", "--config", metavar="AIRCRAFT.toml", help="aircraft file, or the name of a shipped one")
    parser.add_argument(
        "--servo",
        metavar="NAME",
        help="servo of all surfaces: of the library, FILE.toml, or unknown (fitted)",
    )
    parser.add_argument("--include-position", action="store_true", help="show where the aircraft flew")
    parser.add_argument(
        "--map", action="store_true", help="show it on a map, which the viewer loads from openstreetmap.org"
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Open the viewer, after an audit if need be."""
    from servofd.outputs.recording.read import is_recording
    from servofd.outputs.recording.stream import shown
    from servofd.outputs.recording.viewer import check_display, open_viewer

    path = Path(options.file)
    check_display()
    recorded, whole = is_recording(path), str(path.resolve())
    if recorded and shown(whole) == whole:
        open_viewer(path)
        return 0
    with tempfile.TemporaryDirectory(prefix="servofd-") as folder:
        recording = Path(folder) / f"{shown(path.stem)}.rrd"
        if recorded:
            # The viewer draws the name of the file, and crashes at a letter that its font lacks.
            recording.symlink_to(whole)
        else:
            _audit(options, recording)
        open_viewer(recording)
    return 0


def _audit(options: argparse.Namespace, target: Path) -> None:
    """Write the recording of the first run of a log, and print its verdicts."""
    from servofd.cli.tables import print_verdicts, progress_bar
    from servofd.jobs.workflow import audit
    from servofd.outputs.recording import save_recording

    with progress_bar(Path(options.file).name, 1) as step:
        found = next(audit(options.file, options.config, servo=options.servo, progress=step))
    save_recording(found, target, include_position=options.include_position, online_map=options.map)
    print_verdicts(found)
