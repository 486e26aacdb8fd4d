"""The table of effects in docs/aircraft-file.md, from their classes: `python docs/make_effects.py`."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

from servofd.servo.effect import Effect
from servofd.servo.registry import catalogue, is_built_in

PAGE = Path(__file__).parent / "aircraft-file.md"
HEAD = "| effect | what it is | where it acts | parameters, bounds | `form` |\n|---|---|---|---|---|\n"


def table() -> str:
    """Rows of all effects of the package, forms of one effect together, the usual one first."""
    by_name: dict[str, list[type[Effect]]] = defaultdict(list)
    for effect in filter(is_built_in, catalogue()):
        by_name[effect.name].append(effect)
    return HEAD + "".join(_row(effect) for forms in by_name.values() for effect in forms)


def _row(effect: type[Effect]) -> str:
    what = " ".join((effect.__doc__ or "").split()).partition(". ")[0].removesuffix(".")
    needs = "".join(f"; needs `{name}` in the log" for name in effect.needs)
    numbers = ", ".join(f"`{p.name}` {p.low:g} … {p.high:g}" for p in effect.parameters)
    form = f"`{effect.form}`" if effect.form else ""
    return f"| `{effect.name}` | {what}{needs} | {effect.slot.value} | {numbers} | {form} |\n"


def with_table(page: str) -> str:
    """The page with the table of today."""
    before, _, rest = page.partition(HEAD)
    return before + table() + "\n" + rest.partition("\n\n")[2]


if __name__ == "__main__":
    PAGE.write_text(with_table(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
