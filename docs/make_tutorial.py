"""Make ``docs/tutorial.md`` and its pictures by running its commands: ``python docs/make_tutorial.py [FOLDER]``."""

from __future__ import annotations

import contextlib
import io
import os
import shlex
import shutil
import sys
import tempfile
from pathlib import Path

from servofd.cli import main as servofd
from servofd.outputs.explain_report import explain_charts
from servofd.outputs.figure import chart_png
from servofd.results.models import explain

HERE = Path(__file__).parent
LOOSE = "loose.csv"

TEXT = f"""# From a first log to a verdict

Every command and picture on this page was made by `python docs/make_tutorial.py`.

## A log

Any log will do that holds each servo's command *and* the position of its surface. Have none yet? Simulate one: an ArduPilot log
of 60 s in which the elevator jams at 20 s.

@ simulate -o flight.bin --duration 60 --seed 2 --fault elevator:stuck@20
@ info flight.bin

For each surface the log holds a command and a position, so there is something to judge.

## The verdict

@ audit flight.bin -o out --html report.html

The exit code is 1: a fault was found (0 is healthy, 2 could not tell). `report.html` is the page to send to others
([what is in it](report.md)); `out` holds the pictures, a recording for Rerun and the numbers.

![The elevator stays where it is while the command goes on; the residual leaves its threshold](tutorial/flight-elevator.png)

Above: from 20 s on the measured deflection no longer follows the simulated one. Below: the residual, which commands cannot
move as long as the servo is healthy, leaves its threshold when the elevator is next needed.

## Smaller faults: an aircraft file

For that verdict servofd fitted each servo to the part of the log that explains the rest. What is wrong from the first
second on, or smaller than one flight can tell, it cannot know. An aircraft file, calibrated on a flight that was good, can.

@ simulate -o good.bin --duration 240 --seed 1
@ calibrate good.bin -o plane.toml
@ simulate -o small.bin --duration 60 --seed 3 --fault elevator:bias@20:bias_deg=1
@ audit small.bin -c plane.toml

More on this in [Calibration](calibrate.md).

## Suspect, but nothing is broken

The linkage of the next elevator has one degree of play. Nothing breaks in this flight, and yet the audit sees that the servo
is not the one of the library:

@ simulate -o {LOOSE} --effect elevator:backlash:width_deg=1 --noise-deg 0.05 --command gusty --seed 1
@ audit {LOOSE} -s elevator --servo hs225bb-eq31 -o before

![Command, deflections and residual; the residual stays below the threshold but is far from noise](tutorial/before-elevator.png)

What is the matter? `explain` looks for the effect that the model lacks, and tests it on samples that it was not fitted to:

@ explain {LOOSE} -s elevator --servo hs225bb-eq31 --save better.toml --html gap.html

It is backlash: about one degree of play in the linkage. `gap.html` shows it. Where model and measurement differed most, the
model with backlash now runs through the measurement:

![Command, measurement and both models](tutorial/traces.png)

Before, the error was half a degree whichever way the surface moved, of the other sign each way; now only noise is left:

![Error over the speed of the surface, before and after](tutorial/over-speed.png)

With the better aircraft file the same log is healthy, its residual is a fraction of what it was, and a threshold of a third of
the usual one stays quiet. That is how much smaller a fault can now be found:

@ audit {LOOSE} -s elevator -c better.toml --threshold-deg 0.5

If play of one degree is more than you accept, you have found your fault as well. [The second tutorial](tutorial-explain.md)
goes on from here.
"""


def main(folder: Path) -> None:
    pictures = folder / "tutorial"
    pictures.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as work, contextlib.chdir(work):
        lines = [shown(line[2:]) if line.startswith("@ ") else line for line in TEXT.splitlines()]
        shutil.copy(Path("out", "flight-elevator.png"), pictures)
        shutil.copy(Path("before", LOOSE.replace(".csv", "-elevator.png")), pictures / "before-elevator.png")
        charts = explain_charts(explain(LOOSE, surface="elevator", servo="hs225bb-eq31").explanation)
        for name, chart in charts.items():
            if f"{name}.png" in TEXT:
                (pictures / f"{name}.png").write_bytes(chart_png(chart))
    page = "\n".join(lines).replace("```\n```console\n", "") + "\n"
    (folder / "tutorial.md").write_text(page, encoding="utf-8")
    print(folder / "tutorial.md")


def shown(command: str) -> str:
    """A command of the page, run in the current folder, with what it prints."""
    words, _, target = command.partition(" > ")
    output = io.StringIO()
    with contextlib.redirect_stdout(output):
        code = servofd(shlex.split(words))
    if code not in (0, 1, 2):
        raise RuntimeError(f"servofd {command}: exit code {code}")
    printed = "\n".join(line.rstrip() for line in output.getvalue().splitlines()).strip("\n")
    if target:
        Path(target).write_text(output.getvalue(), encoding="utf-8")
        printed = ""
    return "\n".join(filter(None, ["```console", f"$ servofd {command}", printed, "```"]))


if __name__ == "__main__":
    os.environ.setdefault("COLUMNS", "100")
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE)
