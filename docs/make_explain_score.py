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


def main() -> int:
    score_all = run_path(str(SCORE))["main"]
    table = io.StringIO()
    with contextlib.redirect_stdout(table):
        code = int(score_all([]))
    (HERE / "explain_score.md").write_text(HEAD + table.getvalue())
    print(HERE / "explain_score.md")
    return code


if __name__ == "__main__":
    raise SystemExit(main())
