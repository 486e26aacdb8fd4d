"""Which channels are wanted: names, prefixes, and patterns with wildcards."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

SENDER = r"(?:\d+/\d+:)?"
"""MAVLink's system and component, which stand before a name where several send the same message."""


@dataclass(frozen=True)
class Only:
    """A choice of channels.

    `patterns`: ``"RCOU"`` is every channel of that message, ``"CSRV[0]"`` every one of that instance,
    ``"CSRV[0].Pos"`` one; ``*`` stands for any characters and ``?`` for one, brackets for themselves. None is
    everything.
    """

    patterns: tuple[str, ...] | None = None

    @classmethod
    def of(cls, names: str | Sequence[str] | None) -> Only:
        """Make a choice of one pattern, of several, or of none at all."""
        return cls((names,) if isinstance(names, str) else None if names is None else tuple(names))

    def __contains__(self, name: object) -> bool:
        return self._expression is None or bool(self._expression.fullmatch(str(name)))

    def pick(self, names: Iterable[str]) -> list[str]:
        """Those of the names that are wanted, in their order."""
        return [name for name in names if name in self]

    @cached_property
    def topics(self) -> Only:
        """The same choice for names of whole messages: what stands before the first dot or bracket."""
        if self.patterns is None:
            return self
        return Only(tuple(re.split(r"[.\[]", pattern.rpartition(":")[2])[0] for pattern in self.patterns))

    @cached_property
    def _expression(self) -> re.Pattern[str] | None:
        if self.patterns is None:
            return None
        parts = "|".join(re.escape(p).replace(r"\*", ".*").replace(r"\?", ".") for p in self.patterns)
        return re.compile(rf"(?s:{SENDER}(?:{parts})(?:[.\[].*)?)")
