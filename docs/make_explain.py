"""Make ``docs/tutorial-explain.md`` and its pictures by running its commands: ``python docs/make_explain.py [FOLDER]``."""

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

HERE = Path(__file__).parent
PICTURES = {"before": "first", "after": "first", "missed": "ill", "found": "ill"}
"""Folder of an audit, and the log whose picture is shown."""

TEXT = """# A fault inside the play

From a servo that an audit calls *suspect*, through the effect that its model lacks, to an audit that is quiet, and finds a
fault smaller than what its model got wrong before. Every command and picture here was made by
`python docs/make_explain.py`.

## Suspect

A flight in which the linkage of the elevator has a degree of play. The audit knows the servo by its name, and not of the play:

@ simulate -o first.csv --effect elevator:backlash:width_deg=1 --noise-deg 0.05 --command gusty --seed 4
@ audit first.csv -s elevator --servo hs225bb-eq31 -o before

![The residual stays below its threshold, but jumps with every reversal](explain/before.png)

No alarm: a play of that kind may be how this servo is. But the residual jumps by a degree at each reversal, and any fault
below that is lost in it.

## What is missing

@ explain first.csv -s elevator --servo hs225bb-eq31 --save better.toml --rrd gap.rrd

Backlash, about a degree of it, and nothing else: on samples to which nothing was fitted, the error falls to the noise floor.

`gap.rrd` shows both simulations beside the measurement in Rerun (`rerun gap.rrd`). `better.toml` is an aircraft file:

@ cat better.toml

The audit simulates the play from now on, and the same log is healthy:

@ audit first.csv -s elevator -c better.toml --threshold-deg 0.25 -o after

![The residual is noise, and stays far below a threshold of a sixth of the usual one](explain/after.png)

## Does it hold on another flight?

A model that was fitted to one flight proves itself on others. Two more, simulated with the same play:

@ simulate -o second.csv --effect elevator:backlash:width_deg=1 --noise-deg 0.05 --command gusty --seed 1
@ simulate -o third.csv --effect elevator:backlash:width_deg=1 --noise-deg 0.05 --command gusty --seed 2
@ explain first.csv -s elevator --servo hs225bb-eq31 --also second.csv third.csv --json why.json

`--also` fits nothing to them. `servofd explain one.csv two.csv` fits both together, and holds every other one out whole.
Good flights also tell how small thresholds may be:

@ calibrate second.csv third.csv -c better.toml -o calibrated.toml

## A fault that was hidden

Now the elevator's linkage slips by 0.6 deg in mid-flight, which is less than its play.

@ simulate -o ill.csv --effect elevator:backlash:width_deg=1 --noise-deg 0.05 --seed 3 --fault elevator:bias@30:bias_deg=0.6
@ audit ill.csv -s elevator --servo hs225bb-eq31 -o missed
@ audit ill.csv -c calibrated.toml -o found

![Without the play in the model: the slip drowns in the residual](explain/missed.png)

![With it: the residual leaves its threshold where the linkage slips](explain/found.png)

Without the play in its model the audit sees the play. With it, it sees the slip, and when it came.

## Where to go on

[How the search works](explain.md), what the [table of effects](aircraft-file.md#effects) may hold, and how to try
[an effect of your own](explain.md#an-effect-of-your-own).
"""


def main(folder: Path) -> None:
    pictures = folder / "explain"
    pictures.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as work, contextlib.chdir(work):
        lines = [shown(line[2:]) if line.startswith("@ ") else line for line in TEXT.splitlines()]
        for name, log in PICTURES.items():
            shutil.copy(Path(name) / f"{log}-elevator.png", pictures / f"{name}.png")
    page = "\n".join(lines).replace("```\n```console\n", "") + "\n"
    (folder / "tutorial-explain.md").write_text(page, encoding="utf-8")
    print(folder / "tutorial-explain.md")


def shown(command: str) -> str:
    """A command of the page, run in the current folder, with what it prints."""
    prompt, printed = f"$ servofd {command}", ""
    if command.startswith("cat "):
        prompt, printed = f"$ {command}", Path(command.removeprefix("cat ")).read_text(encoding="utf-8").strip()
    else:
        output = io.StringIO()
        with contextlib.redirect_stdout(output):
            code = servofd(shlex.split(command))
        if code not in (0, 1, 2):
            raise RuntimeError(f"servofd {command}: exit code {code}")
        printed = "\n".join(line.rstrip() for line in output.getvalue().splitlines()).strip("\n")
    return "\n".join(filter(None, ["```console", prompt, printed, "```"]))


if __name__ == "__main__":
    os.environ.setdefault("COLUMNS", "100")
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE)
