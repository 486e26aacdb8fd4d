"""Live MAVLink frames: messages in and out of bytes, version 1 or 2, signed or not."""

from __future__ import annotations

import hashlib
import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

from pymavlink.dialects.v20 import all as version_2

from logparsers.protocol import CHECK_BYTES, HEADER_1, HEADER_2, MARKER_1, MARKER_2, SIGNATURE_BYTES, SIGNED

if TYPE_CHECKING:
    from collections.abc import Iterator

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

    Parameters
    ----------
    key : bytes
        32 of them.
    time_s : float
        Seconds since 1970 when signing begins; signatures are numbered from there on, and never go back.
    """

    key: bytes
    time_s: float

    def of_any_time(self) -> Signature:
        """The same key for frames of a record: however old, each is newer than the one before."""
        return Signature(self.key, _SIGNING_EPOCH_S)


def is_signed(frame: bytes) -> bool:
    """Whether a frame says that it carries a signature, be that right or wrong.

    Examples
    --------
    >>> is_signed(Codec(1, 1, signature=Signature(bytes(32), 1.7e9)).encode("HEARTBEAT", {}))
    True
    >>> is_signed(Codec(1, 1).encode("HEARTBEAT", {}))
    False
    """
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


class _Kind:
    """How to read one type of message, from pymavlink's own description of it."""

    __slots__ = ("_fields", "_size", "_unpacker", "name", "seed")

    def __init__(self, message: Any) -> None:  # noqa: ANN401 - a generated class
        self.name: str = message.msgname
        self.seed = bytes([message.crc_extra])
        self._unpacker = message.unpacker
        self._size: int = message.unpacker.size
        types = dict(zip(message.fieldnames, message.fieldtypes, strict=True))
        self._fields: list[tuple[str, int, int, bool]] = []
        """Name, place of its first number, how many there are, and whether it is a text."""
        at = 0
        for name, length in zip(message.ordered_fieldnames, message.array_lengths, strict=True):
            is_text = types[name] == "char"
            count = 1 if is_text else max(length, 1)
            self._fields.append((name, at, count, is_text))
            at += count
        self._fields.sort(key=lambda field: message.fieldnames.index(field[0]))

    def read(self, payload: bytes) -> dict[str, Any]:
        """Values by name; zeros at the end of a payload are not sent."""
        row = self._unpacker.unpack(payload[: self._size].ljust(self._size, b"\0"))
        return {
            name: row[at].split(b"\0", 1)[0].decode("ascii", errors="replace")
            if is_text
            else (row[at] if count == 1 else list(row[at : at + count]))
            for name, at, count, is_text in self._fields
        }


class _Fields(Mapping[str, Any]):
    """Values of a message, read when the first of them is asked for: most messages of a stream are never used."""

    __slots__ = ("_kind", "_payload", "_values")

    def __init__(self, kind: _Kind, payload: bytes) -> None:
        self._kind, self._payload = kind, payload
        self._values: dict[str, Any] | None = None

    def _all(self) -> dict[str, Any]:
        if self._values is None:
            self._values = self._kind.read(self._payload)
        return self._values

    def __getitem__(self, name: str) -> Any:  # noqa: ANN401 - numbers, lists and texts
        return self._all()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._all())

    def __len__(self) -> int:
        return len(self._all())


class Codec:
    """One end of a link, with the counter of its frames.

    Parameters
    ----------
    system, component : int
        Who speaks.
    version : {1, 2}
        Of the frames it sends, without the fields and messages that version 1 lacks; it reads both.
    signature : Signature, optional
        Signs what it sends, and passes over what is not signed with that key.

    Examples
    --------
    >>> plane, ground = Codec(1, 1), Codec(255, 190)
    >>> messages = ground.decode(plane.encode("HEARTBEAT", {"type": 1, "autopilot": 3}))
    >>> [(m.name, m.system, m.fields["type"]) for m in messages]
    [('HEARTBEAT', 1, 1)]
    """

    def __init__(
        self, system: int, component: int, *, version: Literal[1, 2] = 2, signature: Signature | None = None
    ) -> None:
        self._mav = version_2.MAVLink(None, srcSystem=system, srcComponent=component)
        self._mav.robust_parsing = True
        self._dialect: Any = importlib.import_module("pymavlink.dialects.v10.all") if version == 1 else version_2
        self._kinds: dict[str, tuple[Any, dict[str, Any]]] = {}
        self._read: dict[int, _Kind] = {}
        self._is_open = signature is None
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

    @property
    def has_key(self) -> bool:
        """Whether frames have to be signed with its key."""
        return not self._is_open

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
        at = self._whole(data, found) if self._is_open and self._mav.buf_len() == 0 else 0
        if at == len(data):
            return found
        for m in self._mav.parse_buffer(data[at:]) or ():
            name = m.get_type()
            if name == "BAD_DATA" or name.startswith("UNKNOWN"):
                found.append((bytes(m.data) if name == "BAD_DATA" else bytes(m.get_msgbuf()), None))
            else:
                message = Received(name, m.get_srcSystem(), m.get_srcComponent(), _fields(m), m.get_seq())
                found.append((bytes(m.get_msgbuf()), message))
        return found

    def _whole(self, data: bytes, found: list[tuple[bytes, Received | None]]) -> int:
        """Add the whole, undamaged frames at the beginning of the bytes; pymavlink goes on where they end."""
        at, size = 0, len(data)
        while size - at >= _SHORTEST:
            marker, flags = data[at], 0
            if marker == MARKER_2:
                _, length, flags, _, sequence, system, component = data[at : at + 7]
                begin = at + HEADER_2
                number = int.from_bytes(data[at + 7 : begin], "little")
            elif marker == MARKER_1:
                _, length, sequence, system, component, number = data[at : at + HEADER_1]
                begin = at + HEADER_1
            else:
                break
            end = begin + length + CHECK_BYTES
            after = end + SIGNATURE_BYTES if flags == SIGNED else end
            kind = self._read.get(number) or self._known(number)
            if kind is None or flags & ~SIGNED or after > size:
                break
            check = version_2.x25crc(data[at + 1 : end - 2] + kind.seed).crc
            if check != data[end - 2] | data[end - 1] << 8:
                break
            fields = _Fields(kind, data[begin : end - 2])
            found.append((data[at:after], Received(kind.name, system, component, fields, sequence)))
            at = after
        return at

    def _known(self, number: int) -> _Kind | None:
        message = version_2.mavlink_map.get(number)
        if message is not None:
            self._read[number] = _Kind(message)
        return self._read.get(number)

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


def _fields(message: Any) -> dict[str, Any]:  # noqa: ANN401 - a generated class
    return {name: getattr(message, name) for name in message.get_fieldnames()}
