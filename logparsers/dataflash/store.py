"""What the binary and the text form of a DataFlash log have in common: messages by name, column by column."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from logparsers.dataflash.formats import Layout


@dataclass(frozen=True, slots=True)
class Stretch:
    """Bytes of a log that belong to no sound record.

    `offset`, `length`: where, and how many [bytes]. `kind`: ``"zeros"``, ``"erased"`` (all FF), ``"garbage"``,
    ``"cut_record"`` (shorter than its type, or a header that never was one), ``"unknown_type"``, ``"truncated"`` (the
    file ends inside it) or ``"bad_line"``. `before_us`, `after_us`: the vehicle's time before and after it [us].
    """

    offset: int
    length: int
    kind: str
    before_us: int | None = None
    after_us: int | None = None


@dataclass(frozen=True, slots=True)
class Step:
    """The clock went from one time to another without passing between.

    `offset`: first record after it [bytes]. `before_us`, `after_us`: the vehicle's time before and after it [us].
    """

    offset: int
    before_us: int
    after_us: int


class Store(Protocol):
    """Where the columns come from."""

    @property
    def size(self) -> int:
        """Bytes in the file."""

    @property
    def layouts(self) -> Mapping[str, Layout]:
        """Every message that is defined."""

    @property
    def stretches(self) -> Sequence[Stretch]:
        """Damaged bytes, up to a limit."""

    @property
    def more_stretches(self) -> tuple[int, int]:
        """Stretches beyond that limit: how many, how many bytes."""

    @property
    def steps(self) -> Sequence[Step]:
        """Gaps and jumps of the clock."""

    @property
    def notes(self) -> Sequence[str]:
        """What is odd about the definitions."""

    def count(self, name: str) -> int:
        """Count the rows of a message."""

    def offsets(self, name: str) -> NDArray[Any]:
        """Where in the file each row begins [bytes]."""

    def read(self, name: str, fields: Sequence[str], rows: NDArray[np.intp] | None = None) -> dict[str, NDArray[Any]]:
        """Decode columns, of all rows or of some."""

    def suspect(self, name: str) -> NDArray[np.bool_]:
        """Mark rows whose time stamp contradicts the rows around them."""
