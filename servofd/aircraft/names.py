"""Short names of surfaces, for texts and messages that have little room."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable
from itertools import count

_WORDS = {
    "AILERON": "AIL", "ELEVATOR": "ELEV", "RUDDER": "RUD", "ELEVON": "EVON", "RUDDERVATOR": "RVTR",
    "FLAPERON": "FLPR", "SPOILER": "SPOIL", "THROTTLE": "THR", "SURFACE": "SURF", "INNER": "IN", "OUTER": "OUT",
    "LEFT": "L", "RIGHT": "R",
}  # fmt: skip


def short_names(names: Iterable[str], room: int) -> dict[str, str]:
    """Plain capitals for each name, of `room` characters at most; its number or side, at its end, is kept."""
    names = list(names)
    plain = {name: _plain(name) for name in names}
    wanted = {name: _fitted(plain[name], room) for name in names}
    taken: dict[str, str] = {}
    # Whoever needs no change comes first, and has its own name whoever else would like it.
    for name in sorted(names, key=lambda name: wanted[name] != name.upper()):
        short, numbers = wanted[name], count(1)
        while short in taken.values():
            tail = f"~{next(numbers)}"
            short = wanted[name][: room - len(tail)] + tail
        taken[name] = short
    return {name: taken[name] for name in names}


def _plain(name: str) -> str:
    letters = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode().upper()
    return re.sub(r"[^A-Z0-9]+", "_", letters).strip("_") or "SURFACE"


def _fitted(plain: str, room: int) -> str:
    if len(plain) <= room:
        return plain
    words = [_WORDS.get(word, word) for word in plain.split("_")]
    shorter = "_".join(words)
    if len(shorter) <= room:
        return shorter
    tail = re.search(r"\d+$", shorter)
    end = tail[0] if tail else words[-1] if len(words) > 1 else ""
    head = shorter.removesuffix(end).rstrip("_") if len(end) < room else ""
    return (head[: max(room - len(end), 0)] + end)[:room]
