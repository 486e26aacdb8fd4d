"""Write PX4 logs: for simulated flights, and for tests of whoever reads them."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from logparsers.interleave import interleave
from logparsers.records import Text
from logparsers.units import C_NUMBERS, US_PER_S

_MAGIC: Final = b"ULog\x01\x12\x35\x01"
_TYPES: Final = {kind.strip("<"): name for name, kind in C_NUMBERS.items()}


@dataclass(frozen=True, slots=True, eq=False)
class Topic:
    """All samples of one topic.

    `name`: as PX4 calls it. `columns` (shape (n,) or (n, k)): fields by name; their types become those of the log,
    bytes become characters. The first is ``timestamp`` [us since boot]. `instance`: which of several sources.
    """

    name: str
    columns: Mapping[str, NDArray[Any]]
    instance: int = 0

    @property
    def format(self) -> str:
        """Definition of the topic, as the log has it."""
        fields = (f"{_kind(values)} {name};" for name, values in self.columns.items())
        return f"{self.name}:{''.join(fields)}"


def encode(
    topics: Sequence[Topic],
    *,
    parameters: Mapping[str, int | float] | None = None,
    information: Mapping[str, int | str] | None = None,
    texts: Sequence[Text] = (),
) -> bytes:
    """Write a log: definitions and parameters first, then all samples in the order of time.

    `parameters`: settings of the autopilot; the type of the number decides that in the log (32 bits). `information`:
    what the log says about itself, for example ``ver_sw_release``. `texts`: what the autopilot said; those without
    severity are information. Result: the content of a ``.ulg`` file.
    """
    stamps = [topic.columns["timestamp"] for topic in topics]
    begin_us = min((int(t[0]) for t in stamps if t.size), default=0)
    head = [_MAGIC, struct.pack("<Q", begin_us), _message("B", bytes(40))]
    for key, value in (information or {}).items():
        text = value.encode() if isinstance(value, str) else None
        kind, raw = ("uint32_t", struct.pack("<I", value)) if text is None else (f"char[{len(text)}]", text)
        head.append(_message("I", _keyed(f"{kind} {key}", raw)))
    head += [_message("F", text.encode()) for text in dict.fromkeys(topic.format for topic in topics)]
    for key, number in (parameters or {}).items():
        whole = isinstance(number, int)
        raw = struct.pack("<i" if whole else "<f", number)
        head.append(_message("P", _keyed(f"{'int32_t' if whole else 'float'} {key}", raw)))
    head += [_message("A", struct.pack("<BH", t.instance, k) + t.name.encode()) for k, t in enumerate(topics)]
    times: list[ArrayLike] = [*stamps]
    records = [_records(k, topic) for k, topic in enumerate(topics)]
    for words in texts:
        said = _message("L", _spoken(words))
        times.append([round(words.time_s * US_PER_S)])
        records.append(np.array([said], f"V{len(said)}"))
    return b"".join(head) + interleave(times, records)


def _kind(values: NDArray[Any]) -> str:
    count = f"[{values.shape[1]}]" if values.ndim > 1 else ""
    if values.dtype.kind == "S":
        return f"char[{values.dtype.itemsize}]"
    return f"{_TYPES[values.dtype.str[1:]]}{count}"


def _message(kind: str, content: bytes) -> bytes:
    return struct.pack("<HB", len(content), ord(kind)) + content


def _keyed(key: str, value: bytes) -> bytes:
    return bytes((len(key),)) + key.encode() + value


def _spoken(text: Text) -> bytes:
    level = 6 if text.severity is None else text.severity
    return struct.pack("<BQ", ord("0") + level, round(text.time_s * US_PER_S)) + text.text.encode()


def _records(number: int, topic: Topic) -> NDArray[Any]:
    """All samples of one topic as messages of the log, packed."""
    head = [("size", "<u2"), ("kind", "u1"), ("number", "<u2")]
    fields = [(f"{name}:", v.dtype.newbyteorder("<"), v.shape[1:]) for name, v in topic.columns.items()]
    record = np.dtype([*head, *fields])
    rows = np.zeros(len(topic.columns["timestamp"]), record)
    rows["size"], rows["kind"], rows["number"] = record.itemsize - 3, ord("D"), number
    for name, values in topic.columns.items():
        rows[f"{name}:"] = values
    return rows
