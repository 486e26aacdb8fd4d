"""Have `servofd explain` explain every log here, then unseal the truth and score: ``python score.py [LOG...]``."""

from __future__ import annotations

import math
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent.parent / "benchmarks"))  # generator and scores are parts of the benchmarks

from hidden_logs import SURFACE, TRUTH, Recipe, unseal  # noqa: E402
from hidden_score import Answer, Score, ask, score  # noqa: E402


def main(wanted: list[str]) -> int:
    """Print a line for each log and a sum; 1 if an answer is silently wrong or could not be had."""
    recipes = [r for r in unseal((HERE / TRUTH).read_text()) if not wanted or r.file in wanted]
    answers = {r.file: ask(HERE / r.file, SURFACE, "--servo", r.servo) for r in recipes}
    scores = [score(answers[recipe.file].said, recipe.effects, recipe.floor_deg) for recipe in recipes]
    print("| log | hidden | answer | names | worst error | gap closed | s |")
    print("|---|---|---|---|---|---|---|")
    for recipe, one in zip(recipes, scores, strict=True):
        print(row(recipe, one, answers[recipe.file]))
    for complaint in sorted({answer.complaint for answer in answers.values() if answer.said is None}):
        print(complaint, file=sys.stderr)
    known = [one for one in scores if one.conclusion != "could_not_tell"]
    print(
        f"\n{len(known)} of {len(scores)} answered; in the named set {sum(one.in_set for one in known)}, "
        f"names too many {sum(len(one.extra) for one in known)}, "
        f"silently wrong {sum(one.silently_wrong for one in known)}"
    )
    return int(len(known) < len(scores) or any(one.silently_wrong for one in known))


def row(recipe: Recipe, one: Score, answer: Answer) -> str:
    """One log, as a row of a table."""
    hidden = ", ".join(f"{name} {values_of(recipe, name)}" for name in one.hidden) or "nothing"
    named = ", ".join(one.named) or "none"
    worst = f"{100.0 * max(one.errors.values()):.1f} %" if one.errors else ""
    closed = f"{100.0 * one.closure:.1f} %" if not math.isnan(one.closure) else ""
    wrong = " **silently wrong**" if one.silently_wrong else ""
    return (
        f"| {recipe.file} | {hidden} | {one.conclusion}{wrong} | {named} | {worst} | {closed} | {answer.seconds:.1f} |"
    )


def values_of(recipe: Recipe, name: str) -> str:
    """Parameters of a hidden effect."""
    return " ".join(f"{value:g}" for value in recipe.effects[name].values())


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
