"""What reaches a terminal: no control character that a file, a link or an aircraft brought with it."""

from __future__ import annotations

import sys
from contextlib import contextmanager
from typing import IO, TYPE_CHECKING, Any

from servofd.outputs.plain import plain

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rich.console import Console


class _Plain:
    """A text stream to which everything is written plainly."""

    def __init__(self, stream: IO[str]) -> None:
        self.rich_proxied_file = stream
        """Where rich writes its own colours; `console` makes its text plain."""

    def write(self, text: str) -> int:
        return self.rich_proxied_file.write(plain(text))

    def writelines(self, lines: list[str]) -> None:
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - whatever the stream has
        return getattr(self.rich_proxied_file, name)


@contextmanager
def plain_streams() -> Iterator[None]:
    """Write plainly to stdout and stderr within the block."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (stream and _Plain(stream) for stream in before)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before


def console(**options: Any) -> Console:  # noqa: ANN401 - those of rich
    """Console that shows text as it is: no markup, no emoji, nothing that acts.

    Parameters
    ----------
    **options
        Of `rich.console.Console`.
    """
    from rich.console import Console
    from rich.segment import Segment

    class Plain(Console):
        def render(self, *words: Any, **more: Any) -> Iterator[Segment]:  # noqa: ANN401 - as rich has it
            for segment in super().render(*words, **more):
                yield segment if segment.control else Segment(plain(segment.text), segment.style)

    return Plain(highlight=False, markup=False, emoji=False, **options)
