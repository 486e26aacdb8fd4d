"""Score `servofd explain` on the sealed logs and write ``docs/explain_score.md``: ``python docs/make_explain_score.py``."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from runpy import run_path

HERE = Path(__file__).parent
SCORE = HERE.parent / "sample_logs" / "hidden" / "score.py"

HEAD = """# Score sheet of the hidden set

Written by `python docs/make_explain_score.py`: `servofd explain` explains each of the logs in `sample_logs/hidden`, then
their truth is unsealed. They come from a simulator that shares nothing with servofd's kernel. "Worst error" is that of the
worst parameter (of gain and bandwidth, of their deviation from 1), "gap closed" the share of what is not noise that is
gone on samples that were not fitted, s are seconds of one core.

"""


TAIL = """
## Servos of another structure

Not made by that script: `python benchmarks/places.py 1 399`, `python benchmarks/validity.py 1 199` and
`python benchmarks/validity.py 1 599 healthy`. Loops whose slow pole is before or after them, or inside, their poles 3 % off, noise
of 0.1 to 0.3 deg, white or with a colour; the even seeds chose constants, the odd ones are reported.

| 200 logs, 154 with one or two effects | odd seeds |
|---|---|
| named first, in the declared set | 146, 152 of 154 |
| names for each name; with `delay` and `clock_offset`, which nothing tells apart, as one | 1.21; 1.11 |
| "explained", but wrong | 2 |
| nothing named where nothing is hidden | 46 of 46 |
| "explained" or "nothing missing" | 197 |
| processor time of a log of 50 s, on a busy machine: median, 95 % | 1.3, 4.1 s |

One of the two that are wrong is a delay together with slower dynamics in gentle flight. A lagging sensor alone predicts it as
well: no command of it tells them apart, and the single name is taken (7 of 16 even logs of that pair). The other is slower
dynamics beside friction, called a delay.

| runs of unknown servos | odd seeds |
|---|---|
| torque lost in one of 3 to 8 runs, found within 0.3 s of the loss or of what first shows it | 96 of 100 sets |
| a healthy run called not driven | 0 of 300 sets |

## Without a source

`python benchmarks/left_out.py`: each constant that was chosen by what it did on data is chosen again without one source, from the
shipped value, a smaller and a larger one, and that source is explained with all of these. "Right" is the truth in the declared set
(simulators, even seeds), or that the names which the makers' descriptions give are found (bench); the first figure is as shipped, the
second as chosen without the source; the error on data not fitted is over that of the shipped constants.

| left out | records | chosen otherwise | right | names for each name | error |
|---|---|---|---|---|---|
| `places.py` | 12 | none | 12, 12 | 1.08, 1.08 | |
| `hidden_effects.py` | 9 | widths smaller | 9, 9 | 1.00, 1.00 | |
| hobby servo with an encoder | 1 | widths smaller | 1, 1 | 1.67, 1.67 | 1.00 |
| HJ S3315D with weights | 1 | widths smaller | 1, 1 | 1.50, 1.50 | 1.00 |
| Feetech: a weight, play, two joints of an arm | 4 | widths smaller | 3, 3 | 1.62, 1.62 | 1.00 |
| XL330, two gains | 2 | widths smaller | 2, 2 | 1.12, 1.12 | 1.00 |
| EMPS drive | 1 | widths smaller | 1, 1 | 1.50, 1.50 | 1.00 |
| RC servo | 1 | widths smaller | 1, 1 | 1.00, 1.00 | 1.00 |
| Maxon joint | 1 | widths smaller | 1, 1 | 1.00, 1.00 | 1.00 |

| constant (the values that were tried) | what chose the shipped one | what it does |
|---|---|---|
| misfit for a further name (20, 30, 45); share of the gap on top (3e-5, 1e-4, 3e-4) | a prototype on simulated servos | nothing on any source |
| misfit for one of the servo's own numbers (10, 16, 24) | simulated servos, EMPS | 24 loses the offset of EMPS, whose error is then 1.7 times as large |
| probability that is declared (0.9, 0.95, 0.99) | even seeds of `places.py` | 0.99: 0.25 names more for each on those 12 logs; nothing elsewhere |
| how rare effects are (half, as it is, twice) | simulated servos, bench | nothing |
| gain of an unknown servo (0.02, 0.03, 0.05), error of a model (0.01, 0.02, 0.04), what effects may leave (0.35, 0.5, 0.7) | bench | nothing |
| memory at rest (1.3, 1.6, 2) | simulated servos | nothing |
| widths of what servos of a type differ by (0.67, 1, 1.5) | a guess at what servos of a type differ by (poles 3 %), which the simulators share | 0.08 names fewer for each with the smaller ones, on one log of 12 |

The samples are small, and constants were varied one at a time: that says that no source hangs on a value, not that the values are
the best. Ratio (1.1) and predicted share (2 %) of "explained", smallest sizes and grids were set, not fitted.
"""


def main() -> int:
    score_all = run_path(str(SCORE))["main"]
    table = io.StringIO()
    with contextlib.redirect_stdout(table):
        code = int(score_all([]))
    (HERE / "explain_score.md").write_text(HEAD + table.getvalue() + TAIL)
    print(HERE / "explain_score.md")
    return code


if __name__ == "__main__":
    raise SystemExit(main())
