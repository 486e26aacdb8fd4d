"""Live MAVLink frames: messages in and out of bytes, version 1 or 2, signed or not."""

from __future__ import annotations

import hashlib
import importlib
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Final, Literal, NamedTuple

from pymavlink.dialects.v20 import all as version_2

from logparsers.protocol import CHECK_BYTES, HEADER_1, HEADER_2, MARKER_1, MARKER_2, SIGNED, frame_bytes

_SIGNING_EPOCH_S: Final = 1_420_070_400
"""1 January 2015 in seconds since 1970, from which signatures count time (MAVLink 2, message signing)."""
_SIGNING_TICKS_PER_S: Final = 100_000
"""Signatures count time in 10 us (MAVLink 2, message signing)."""
_KEY_SIZE: Final = 32
"""Bytes of a key."""
_SHORTEST = HEADER_2 + CHECK_BYTES
"""Bytes of the shortest frame of version 2: header and check-sum."""


@dataclass(slots=True)
class Received:
    """A message that came in."""

    name: str
    system: int
    component: int
    fields: Mapping[str, Any]
    sequence: int = 0
    """Counts the frames of a sender, modulo 256."""


@dataclass(frozen=True, slots=True)
class Signature:
    """What frames are signed with.

    `key`: 32 of them. `time_s`: seconds since 1970 when signing begins; signatures are numbered from there on, and
    never go back.
    """

    key: bytes
    time_s: float

    def of_any_time(self) -> Signature:
        """The same key for frames of a record: however old, each is newer than the one before."""
        return Signature(self.key, _SIGNING_EPOCH_S)


def is_signed(frame: bytes) -> bool:
    """Whether a frame says that it carries a signature, be that right or wrong."""
    return len(frame) >= _SHORTEST and frame[0] == MARKER_2 and frame[2] & SIGNED != 0


def signing_key(content: bytes) -> bytes:
    r"""Key from the content of a key file: 32 bytes, 64 hexadecimal digits, or a passphrase, which is hashed.

    Ground stations make keys of passphrases the same way (SHA-256 of the text).

    Examples
    --------
    >>> signing_key(b"00" * 32) == bytes(32), signing_key(b"secret\n") == hashlib.sha256(b"secret").digest()
    (True, True)
    """
    if len(content) == _KEY_SIZE:
        return content
    text = content.strip()
    try:
        key = bytes.fromhex(text.decode("ascii"))
    except ValueError:
        key = b""
    return key if len(key) == _KEY_SIZE else hashlib.sha256(text).digest()


class Codec:
    """One end of a link, with the counter of its frames.

    `system`, `component`: who speaks. `version` ({1, 2}): of the frames it sends, without the fields and messages that
    version 1 lacks; it reads both. `signature`: signs what it sends, and passes over what is not signed with that key,
    as `has_key` says.
    """

    def __init__(
        self, system: int, component: int, *, version: Literal[1, 2] = 2, signature: Signature | None = None
    ) -> None:
        self._mav = version_2.MAVLink(None, srcSystem=system, srcComponent=component)
        self._dialect: Any = importlib.import_module("pymavlink.dialects.v10.all") if version == 1 else version_2
        self._kinds: dict[str, tuple[Any, dict[str, Any]]] = {}
        self._begun = b""
        """Of a frame that has not come completely."""
        self.has_key = signature is not None
        if signature is not None:
            self._mav.signing.secret_key = signature.key
            self._mav.signing.sign_outgoing = True
            self._mav.signing.timestamp = int((signature.time_s - _SIGNING_EPOCH_S) * _SIGNING_TICKS_PER_S)

    def encode(self, name: str, fields: Mapping[str, Any]) -> bytes:
        """Frame of a message; a field left out is zero. None at all if version 1 does not know the message."""
        kind, empty = self._kind(name)
        if kind is None:
            return b""
        given = {k: v.encode() if isinstance(v, str) else v for k, v in fields.items() if k in empty}
        frame: bytes = bytes(kind(**(empty | given)).pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
        return frame

    def skip(self, frames: int) -> None:
        """Count frames that are sent elsewhere."""
        self._mav.seq = (self._mav.seq + frames) % 256

    def decode(self, data: bytes) -> list[Received]:
        """Messages that the bytes complete; damaged ones are passed over."""
        return [message for _, message in self.frames(data) if message is not None]

    def frames(self, data: bytes) -> list[tuple[bytes, Received | None]]:
        """Bytes of each frame that was completed, and its message.

        None for damaged bytes, unknown messages, and frames that are not signed as they should be.
        """
        found: list[tuple[bytes, Received | None]] = []
        data, at = self._begun + data, 0
        while at < len(data):
            begin = at
            while at < len(data) and data[at] not in (MARKER_1, MARKER_2):
                at += 1
            if at > begin:
                found.append((data[begin:at], None))
                continue
            size = frame_bytes(data, at)
            if not size or at + size > len(data):
                break
            frame, at = data[at : at + size], at + size
            found.append((frame, self._message(frame)))
        self._begun = data[at:]
        return found

    def _message(self, frame: bytes) -> Received | None:
        """The message of a whole frame; None if it is damaged, unknown, or not signed as it should be."""
        flags = 0
        if frame[0] == MARKER_1:
            begin, (sequence, system, component, number) = HEADER_1, frame[2:HEADER_1]
        else:
            begin, (flags, _, sequence, system, component) = HEADER_2, frame[2:7]
            number = int.from_bytes(frame[7:HEADER_2], "little")
        kind = _kind_of(number)
        if kind is None or flags & ~SIGNED:
            return None
        end = begin + frame[1]
        check = version_2.x25crc(frame[1:end] + kind.seed).crc
        if frame[end : end + CHECK_BYTES] != check.to_bytes(CHECK_BYTES, "little"):
            return None
        if self.has_key and not (flags & SIGNED and self._mav.check_signature(frame, system, component)):
            return None
        return Received(kind.name, system, component, kind.fields(frame[begin:end]), sequence)

    def _kind(self, name: str) -> tuple[Any, dict[str, Any]]:
        """Class of a message, or None, and its fields when they are zero."""
        if name not in self._kinds:
            kind = next((k for k in self._dialect.mavlink_map.values() if k.msgname == name), None)
            empty: dict[str, Any] = {}
            if kind is None:
                return None, empty
            for field, type_name, at in zip(kind.fieldnames, kind.fieldtypes, kind.orders, strict=True):
                length = kind.array_lengths[at]
                empty[field] = b"" if type_name == "char" else [0] * length if length else 0
            self._kinds[name] = kind, empty
        return self._kinds[name]


class _Kind(NamedTuple):
    """How a message is read."""

    name: str
    seed: bytes
    """What ends its check-sum."""
    values: struct.Struct
    """Of the payload."""
    names: tuple[str, ...]
    """Of its fields, as they lie in the payload,"""
    lengths: tuple[int, ...]
    """and how many values each has; none at all where every field is one,"""
    texts: tuple[str, ...]
    """and which of them are text."""

    def fields(self, payload: bytes) -> dict[str, Any]:
        """Fields by name; the sender cuts trailing zeros off, and a newer one may send more."""
        size = self.values.size
        values = self.values.unpack(payload if len(payload) == size else payload[:size].ljust(size, b"\0"))
        fields: dict[str, Any] = {}
        if not self.lengths:
            fields = dict(zip(self.names, values, strict=True))
        at = 0
        for name, length in zip(self.names, self.lengths, strict=False):
            fields[name] = values[at] if length == 1 else list(values[at : at + length])
            at += length
        for name in self.texts:
            fields[name] = fields[name].partition(b"\0")[0].decode("ascii", "replace")
        return fields


@cache
def _kind_of(number: int) -> _Kind | None:
    """A message by its number; None if it is not known."""
    kind: Any = version_2.mavlink_map.get(number)
    if kind is None:
        return None
    names, lengths = tuple(kind.ordered_fieldnames), tuple(kind.lengths)
    texts = tuple(name for name, of in zip(kind.fieldnames, kind.fieldtypes, strict=True) if of == "char")
    lengths = () if set(lengths) == {1} else lengths
    return _Kind(kind.msgname, bytes([kind.crc_extra]), kind.unpacker, names, lengths, texts)
