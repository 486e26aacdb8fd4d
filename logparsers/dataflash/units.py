"""Units of the columns: FMTU gives them as characters, which UNIT and MULT spell out."""

from __future__ import annotations

import math
from collections import defaultdict
from typing import TYPE_CHECKING, Any

from logparsers.dataflash.formats import NUMBER, WORDS, with_units

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from logparsers.dataflash.formats import Layout

    Read = Callable[[str, Sequence[str]], dict[str, NDArray[Any]]]


def apply_units(layouts: dict[str, Layout], read: Read) -> None:
    """Replace layouts by the same with units, where the log tells them."""
    types = defaultdict(list)
    for name, layout in layouts.items():
        types[layout.type].append(name)
    units = {k: str(v) for k, v in _pairs(layouts, read, "UNIT", {"Id": NUMBER, "Label": WORDS})}
    scales = {k: float(f"{v:.7g}") for k, v in _pairs(layouts, read, "MULT", {"Id": NUMBER, "Mult": NUMBER})}
    for kind, unit_ids, scale_ids in _rows(
        layouts, read, "FMTU", {"FmtType": NUMBER, "UnitIds": WORDS, "MultIds": WORDS}
    ):
        for name in types.get(kind, ()):
            layouts[name] = with_units(layouts[name], unit_ids, scale_ids, units, scales)


def _pairs(layouts: dict[str, Layout], read: Read, name: str, wanted: dict[str, bool]) -> list[tuple[str, Any]]:
    """Characters and what they stand for."""
    return [(chr(int(k) & 255), v) for k, v in _rows(layouts, read, name, wanted) if math.isfinite(k)]


def _rows(layouts: dict[str, Layout], read: Read, name: str, wanted: dict[str, bool]) -> list[tuple[Any, ...]]:
    """Rows of a message, if it has these columns and they hold numbers or words as they should."""
    if name not in layouts or not layouts[name].has(wanted):
        return []
    columns = read(name, list(wanted))
    return list(zip(*(columns[f].tolist() for f in wanted), strict=True))
