"""pyulog, kept within bounds on forged files, and quiet. The only file that imports it."""

from __future__ import annotations

import io
import struct
import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from pyulog import core
from pyulog.exceptions import ULogException

from logparsers.errors import UnreadableLog
from logparsers.ulog.sieve import NotPlain

if TYPE_CHECKING:
    from collections.abc import Container, Iterable, Iterator

    import numpy as np
    from numpy.typing import NDArray

    from logparsers.ulog.sieve import Samples

_MAX_FIELDS = 200_000
"""Fields of all topics of a file at most; the richest logs have some ten thousand."""
_MAX_FORMATS = 10_000
"""Message formats at most."""
_MAX_MESSAGE = 65_535
"""Fields of a message at most: it has no more bytes."""
_MAX_DEPTH = 16
"""Messages within messages at most; PX4 nests two."""
_MAX_SKIPS = 20_000
"""Times that pyulog may look for the next message byte by byte."""
_FAILURES = (
    ULogException,
    ArithmeticError,
    AttributeError,
    LookupError,
    MemoryError,
    OSError,
    RecursionError,
    TypeError,
    ValueError,
    struct.error,
)
_QUIET = threading.Lock()


class _Formats(dict[str, Any]):
    """Message formats, and how many fields may still be made of them."""

    def __init__(self) -> None:
        super().__init__()
        self.left = _MAX_FIELDS
        self.announced: dict[str, None] = {}
        self.samples: Samples | None = None
        """Of topics that the file itself does not hold any more."""

    def __setitem__(self, name: str, definition: object) -> None:
        if len(self) >= _MAX_FORMATS:
            raise UnreadableLog(f"more than {_MAX_FORMATS} message formats; PX4 has some hundred")
        super().__setitem__(name, definition)


class _Subscription(core.ULog._MessageAddLogged):  # type: ignore[misc]
    """A topic of a log; refuses formats that spread out beyond what a message can hold."""

    def __init__(self, content: bytes, header: object, message_formats: _Formats) -> None:
        super().__init__(content, header, message_formats)
        message_formats.announced[str(self.message_name)] = None
        if message_formats.samples is not None:
            buffer = message_formats.samples.of(self.msg_id, self.dtype.itemsize, self.max_data_size)
            first = self.field_data[0] if self.field_data else None
            if buffer.size and (first is None or (first.field_name, first.type_str) != ("timestamp", "uint64_t")):
                raise NotPlain
            self.buffer = buffer

    def _parse_nested_type(self, prefix_str: str, type_name: str, message_formats: _Formats) -> None:
        wanted = sum(max(size, 1) for _, size, _ in message_formats[type_name].fields)
        message_formats.left -= wanted
        if message_formats.left < 0 or len(self.field_data) + wanted > _MAX_MESSAGE:
            raise ValueError(f"{type_name}: too many fields")
        if prefix_str.count(".") > _MAX_DEPTH:
            raise ValueError(f"{type_name} contains itself")
        super()._parse_nested_type(prefix_str, type_name, message_formats)


class Reader(core.ULog):  # type: ignore[misc]
    """pyulog within bounds: forged counts and nesting are refused, hopeless searches given up."""

    _MessageAddLogged = _Subscription

    def __init__(self) -> None:
        super().__init__(None)
        self._message_formats = _Formats()
        self.skips, self.start = 0, 0

    @property
    def announced(self) -> Iterable[str]:
        """Topics that the log says it has, read or not."""
        return self._message_formats.announced

    def load(self, handle: io.BytesIO, wanted: Container[str], samples: Samples | None = None) -> None:
        """Read all at once; samples may have been set aside before."""
        self._message_formats.samples = samples
        self._load_file(handle, wanted)
        if samples is not None:
            self._date(samples)

    def _date(self, samples: Samples) -> None:
        """Give dropouts and parameters the time of the samples before them."""
        changed: list[Any] = self.changed_parameters
        if (len(self.dropouts), len(changed)) != (samples.dropouts_us.size, samples.parameters_us.size):
            raise NotPlain
        for dropout, at_us in zip(self.dropouts, samples.dropouts_us.tolist(), strict=True):
            dropout.timestamp = at_us
        changed[:] = [(at_us, *entry[1:]) for at_us, entry in zip(samples.parameters_us.tolist(), changed, strict=True)]

    def _read_file_definitions(self) -> None:
        super()._read_file_definitions()
        self.start = self._file_handle.tell()

    def _check_packet_corruption(self, header: Any) -> bool:  # noqa: ANN401
        corrupt = bool(super()._check_packet_corruption(header))
        self.skips += corrupt
        if self.skips > _MAX_SKIPS:
            if not self.start:
                raise UnreadableLog("the definitions at its start are destroyed")
            raise struct.error("too damaged")  # ends pyulog's loop, and keeps what it has
        return corrupt


class _Whole(io.BytesIO):
    """Knows whether it was read to its end."""

    was_read = False

    def close(self) -> None:
        self.was_read = self.tell() == len(self.getbuffer())
        super().close()


def load(
    data: NDArray[np.uint8], name: str, wanted: Container[str], samples: Samples | None = None
) -> tuple[Reader, tuple[str, ...], str]:
    """Read the chosen topics of a log.

    `data` (shape (n,)): the file. `samples`: those that were set aside before. Result: `stopped`: why reading was
    given up early; empty if it was not.
    """
    reader, handle = Reader(), _Whole(data.tobytes())
    try:
        with _quiet() as said:
            reader.load(handle, wanted, samples)
        if samples is not None and not handle.was_read:
            raise NotPlain
    except UnreadableLog as error:
        raise UnreadableLog(f"{name}: {error}; copy the log again") from None
    except _FAILURES as error:
        raise UnreadableLog(f"{name}: not a sound PX4 log: {str(error) or type(error).__name__}") from error
    return reader, tuple(said), "too damaged: reading was given up" if reader.skips > _MAX_SKIPS else ""


@contextmanager
def _quiet() -> Iterator[list[str]]:
    """Collect what pyulog would print. Only its own `print` is replaced: other threads keep their output."""
    said: list[str] = []
    with _QUIET:
        vars(core)["print"] = lambda *words: said.append(" ".join(map(str, words))) if len(said) < 10 else None
        try:
            yield said
        finally:
            del vars(core)["print"]
