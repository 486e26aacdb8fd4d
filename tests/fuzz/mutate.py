"""Ways to break a file: its bytes, its messages, its numbers. Seeded, so that whatever breaks can be made again."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from logparsers.mavlink import dialect
from logparsers.telemetry.frames import check_sum

if TYPE_CHECKING:
    import random

__all__ = ["BYTES", "DATAFLASH", "FRAMES", "LINES", "RECORDS", "TELEMETRY", "ULOG", "Shape", "mutant", "mutated"]

EXTREMES = (
    b"\xff\xff\xff\xff",
    b"\x7f\xff\xff\xff",
    b"\xff\xff\xff\x7f",
    b"\0\0\0\0",
    b"\0\0\xf0\x7f",
    b"\x7f\xa0\0\0",
    b"\xa3\x95\x80",
    b"\xfd\xff\0\0",
)
NUMBERS = (0.0, -0.0, 1.0, -1.0, 5e-324, 1e-30, 1e30, 1e38, 1e308, -1e308, np.inf, -np.inf, np.nan)
WHOLE = (0, 1, 2, 127, 255, 256, 32767, 65535, 2**24 + 1, 2**31 - 1, 2**31, 2**32 - 1, 2**53 + 1, 2**63 - 1, 2**64 - 1)
WORDS = (
    *b"nan inf -inf 1e308 -1e308 1e-320 1e999 -1 0 -0.0 1_000 0x1F 9007199254740993 4294967296 true [] {} ''".split(),
    *b"1e-9 5e5 -7.25 2026-01-01 \xff \xef\xbc\x91 \0 [[a]]\n".split(b" "),
    *(b"", b" ", b"\n", b'"', b"9" * 5000, b"[" * 1500, b'"' + b"a" * 3000 + b'"'),
)
FIELDS = [order + kind for order in "<>" for kind in "bhiqefd"]
_NUMBER = re.compile(rb"-?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[\w.+-]+")

Split = Callable[[bytes], list[bytes]]


@dataclass(frozen=True, slots=True)
class Shape:
    """What a mutator needs to know of a format.

    Parameters
    ----------
    split : callable
        Takes a file apart into its messages; joined they are the file again.
    seal : callable
        Puts the check-sum of a message right after a change.
    text : bool
        Whether numbers are written in digits.
    """

    split: Split
    seal: Callable[[bytes], bytes] = bytes
    text: bool = False


def mutant(rng: random.Random, corpus: Sequence[bytes], shape: Shape) -> bytes:
    """Break one file of a corpus: its bytes, or its messages and the numbers in them."""
    content = rng.choice(corpus)
    if rng.random() < 0.35:
        return mutated(rng, content)
    pieces = shape.split(content)
    for _ in range(rng.choice([1, 1, 1, 2, 3, 8])):
        if rng.random() < 0.5:
            _rearrange(rng, pieces, corpus, shape)
        elif pieces:
            at = rng.randrange(len(pieces)) if rng.random() < 0.7 else rng.randrange(min(len(pieces), 12))
            change = _reworded if shape.text else _renumbered
            pieces[at] = shape.seal(change(rng, pieces[at], rng.choice(pieces)))
    return b"".join(pieces)


def mutated(rng: random.Random, content: bytes) -> bytes:
    """Cut, grow, shrink, repeat, flip or overwrite, up to eight times; half of the time where the headers are."""
    broken = bytearray(content)
    for _ in range(rng.choice([1, 1, 1, 2, 3, 8])):
        at = rng.randrange(max(len(broken), 1)) if rng.random() < 0.5 else rng.randrange(min(len(broken), 800) or 1)
        size = rng.randrange(1, 60)
        match rng.randrange(8):
            case 0:
                del broken[at + rng.randrange(len(broken) or 1) :]
            case 1:
                broken[at:at] = rng.randbytes(size)
            case 2:
                del broken[at : at + size]
            case 3:
                broken[at:at] = broken[at : at + 8 * size]
            case 4:
                broken[at : at + size] = bytes(min(size, len(broken) - at))
            case 5:
                extreme = rng.choice(EXTREMES)
                broken[at : at + len(extreme)] = extreme
            case _:
                for _ in range(rng.choice([1, 1, 2, 5])):
                    if broken:
                        broken[rng.randrange(min(at + 1, len(broken)))] ^= 1 << rng.randrange(8)
    return bytes(broken)


def _rearrange(rng: random.Random, pieces: list[bytes], corpus: Sequence[bytes], shape: Shape) -> None:
    """Leave out, repeat, exchange, reverse or shuffle messages, or take some of another file."""
    if not pieces:
        return
    begin = rng.randrange(len(pieces))
    end = min(begin + rng.choice([1, 1, 2, 5, 40]), len(pieces))
    run = pieces[begin:end]
    match rng.randrange(6):
        case 0:
            del pieces[begin:end]
        case 1:
            pieces[begin:end] = run * rng.choice([2, 3, 20])
        case 2:
            other = rng.randrange(len(pieces))
            pieces[begin], pieces[other] = pieces[other], pieces[begin]
        case 3:
            pieces[begin:end] = run[::-1]
        case 4:
            rng.shuffle(run)
            pieces[begin:end] = run
        case _:
            foreign = shape.split(rng.choice(corpus))
            at = rng.randrange(len(foreign)) if foreign else 0
            pieces[begin:end] = foreign[at : at + len(run)]


def _renumbered(rng: random.Random, piece: bytes, other: bytes) -> bytes:
    """Overwrite one binary number with an extreme one, with a nearby one, or with what another message has there."""
    broken = bytearray(piece)
    code = rng.choice(FIELDS)
    size = struct.calcsize(code)
    if len(broken) < size:
        return mutated(rng, piece)
    at = rng.randrange(len(broken) - size + 1)
    kind = rng.randrange(4)
    if kind == 0:
        broken[at : at + size] = other[at : at + size].ljust(size, b"\0")
    elif code[1] in "efd":
        number = rng.choice(NUMBERS)
        largest = {"e": 65504.0, "f": 3e38, "d": 1e308}[code[1]]
        struct.pack_into(code, broken, at, number if np.isinf(number) else min(max(number, -largest), largest))
    else:
        (now,) = struct.unpack_from(code, broken, at)
        number = rng.choice(WHOLE) if kind == 1 else now + rng.choice([-1, 1, -1000, 1000, -(2**20), 2**20])
        struct.pack_into(code.upper(), broken, at, number % 256**size)
    return bytes(broken)


def _reworded(rng: random.Random, piece: bytes, other: bytes) -> bytes:
    """Replace one number or word of a text."""
    numbers, words = list(_NUMBER.finditer(piece)), list(_WORD.finditer(piece))
    found = rng.choice(numbers or words or [None]) if rng.random() < 0.6 else rng.choice(words or [None])
    if found is None:
        return mutated(rng, piece)
    foreign = _WORD.findall(other)
    new = rng.choice(foreign) if foreign and rng.random() < 0.3 else rng.choice(WORDS)
    if rng.random() < 0.2:
        new = found[0] + new
    return piece[: found.start()] + new + piece[found.end() :]


def _in_pieces(content: bytes) -> list[bytes]:
    return [content[at : at + 64] for at in range(0, len(content), 64)]


def _at(pattern: bytes) -> Split:
    expression = re.compile(b"(?s)(?=" + pattern + b")")
    return lambda content: [piece for piece in expression.split(content) if piece]


def _in_frames(stamp: int) -> Split:
    """MAVLink frames behind that many bytes of time."""

    def split(content: bytes) -> list[bytes]:
        pieces, at = [], 0
        while at + stamp + 3 <= len(content):
            magic, size, flags = content[at + stamp : at + stamp + 3]
            known = {0xFE: 8, 0xFD: 25 if flags & 1 else 12}.get(magic)
            end = at + stamp + (1 if known is None else size + known)
            pieces.append(content[at:end])
            at = end
        return [*pieces, content[at:]]

    return split


def _sealed(stamp: int) -> Callable[[bytes], bytes]:
    """Give a MAVLink frame its right length and check-sum again, where its message is known."""

    def seal(piece: bytes) -> bytes:
        frame = bytearray(piece[stamp:])
        head = {0xFE: 6, 0xFD: 10}.get(frame[0] if frame else 0, 0)
        tail = 15 if head == 10 and len(frame) > 2 and frame[2] & 1 else 2
        if not head or len(frame) < head + tail:
            return piece
        number = frame[5] if head == 6 else int.from_bytes(frame[7:10], "little")
        known = dialect()
        slot = int(known.slots[number]) if number < known.slots.size else -1
        if slot < 0:
            return piece
        end = len(frame) - tail
        frame[1] = (end - head) % 256
        crc = check_sum(np.frombuffer(bytes(frame), np.uint8), 1, end, int(known.seeds[slot]))
        struct.pack_into("<H", frame, end, crc)
        return piece[:stamp] + bytes(frame)

    return seal


def _ulog_messages(content: bytes) -> list[bytes]:
    pieces, at = [content[:16]], 16
    while at < len(content):
        size = int.from_bytes(content[at : at + 2], "little") + 3
        pieces.append(content[at : at + size])
        at += size
    return pieces


def _rrd_messages(content: bytes) -> list[bytes]:
    """Messages of a Rerun recording: kind and length, 8 bytes each, then the content; the file header stands first."""
    pieces, at = [content[:12]], 12
    while at < len(content):
        size = int.from_bytes(content[at + 8 : at + 16], "little") + 16
        pieces.append(content[at : at + size])
        at += size
    return pieces


BYTES = Shape(_in_pieces)
LINES = Shape(lambda content: content.splitlines(keepends=True), text=True)
DATAFLASH = Shape(_at(b"\xa3\x95"))
TELEMETRY = Shape(_in_frames(8), _sealed(8))
FRAMES = Shape(_in_frames(0), _sealed(0))
ULOG = Shape(_ulog_messages)
RECORDS = Shape(_rrd_messages)
