"""Where bytes come from: the only file that opens anything."""

from __future__ import annotations

import mmap
import re
from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np
from numpy.typing import NDArray

from logparsers.archive import beginning, inflated, is_packed, members
from logparsers.errors import EmptyLog, MissingLog, SeveralRuns, UnreadableLog, reason_of

if TYPE_CHECKING:
    from logparsers.records import Damage, FlightLog

LogFile = str | PathLike[str] | BinaryIO
"""What a reader accepts: a path, or a binary file that can seek."""

LogBytes = LogFile | bytes
"""Or the content itself."""

_ADDRESS = re.compile(r"\w{2,}:/")
"""As a path, in which two slashes are one."""

HEAD_BYTES = 4096
"""Bytes from which the format is recognised: room for a HDF5 signature behind a MATLAB header, or for two frames."""
_BLOCK = 1 << 20
"""Bytes that are read at once."""
_ZEROS = bytes(1024)
"""No format begins with as many."""


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """One open log.

    `path`: its name, for messages; ``<file>`` if it has none. `file`: the open file. `head`: its first `HEAD_BYTES`
    bytes, those behind the zeros if it begins with that many. `archive`: where it came from, if that holds several:
    then `path` is that name, and its own behind it. `damage`: what is wrong with that archive.
    """

    path: Path
    file: BinaryIO
    head: bytes
    archive: Path | None = None
    damage: tuple[Damage, ...] = ()

    def content(self) -> bytes:
        """Every byte of the file."""
        try:
            self.file.seek(0)
            return self.file.read()
        except (OSError, MemoryError) as error:
            raise UnreadableLog(f"{self.path}: cannot be read to its end: {reason_of(error)}") from error

    def packed(self, log: FlightLog) -> FlightLog:
        """Add to a log what archive it came from, and what is wrong with that."""
        damage = (*self.damage, *log.damage)
        if self.archive is None:
            return replace(log, damage=damage)
        member = self.path.relative_to(self.archive).as_posix()
        return replace(log, source=self.archive, run=" ".join(filter(None, (member, log.run))), damage=damage)

    def mapped(self) -> NDArray[np.uint8]:
        """Every byte of the file, mapped into memory rather than read where the system can; read only.

        The file may be closed afterwards: the map lives as long as the last array that shows it.
        """
        try:
            return np.frombuffer(mmap.mmap(self.file.fileno(), 0, access=mmap.ACCESS_READ), np.uint8)
        except (OSError, ValueError):  # a file in memory, or a system that cannot
            return np.frombuffer(self.content(), np.uint8)


def mapped(file: LogBytes) -> tuple[NDArray[np.uint8], str]:
    """All bytes of a log, and what to call it.

    Result: `content` (shape (n,)): read only.
    """
    if isinstance(file, bytes):
        if not file:
            raise EmptyLog("<0 bytes>: the file is empty (0 bytes); was the log copied completely?")
        return np.frombuffer(file, np.uint8), f"<{len(file)} bytes>"
    with closing(sources(file)) as found:
        source = next(found)
        if source.archive:
            raise SeveralRuns(f"{source.archive}: an archive of several files; unpack it, and give one of them")
        return source.mapped(), str(source.path)


def sources(file: LogFile) -> Generator[Source]:
    """Open a log, or one file of an archive after the other: each is closed when the next is asked for.

    `file`: a path, or a binary file that can seek; it is read from its beginning and left open. Result: at least one;
    those of an archive of several have the archive's name before theirs.
    """
    with _raw(file) as source:
        if not is_packed(source.head):
            yield source
            return
        packed = members(source.file, source.path)
        if not packed:
            raise EmptyLog(f"{source.path}: the archive holds no file; was it copied completely?")
        several = len(packed) > 1
        for name, unpack in packed:
            path = source.path / name if several else source.path
            with inflated(unpack, path) as (content, damage):
                try:
                    inner = _source(path, content)
                except EmptyLog:
                    if several:
                        continue
                    raise
                yield replace(inner, archive=source.path if several else None, damage=damage)


def heads(file: LogFile, size: int) -> list[bytes]:
    """First bytes of a log, or of each file of an archive, of which no more is unpacked."""
    with _raw(file) as source:
        source.file.seek(0)
        if not is_packed(source.head):
            return [source.file.read(size)]
        return [beginning(unpack, source.path, size) for _, unpack in members(source.file, source.path)]


@contextmanager
def _raw(file: LogFile) -> Iterator[Source]:
    if not isinstance(file, (str, PathLike)):
        yield _source(Path(str(getattr(file, "name", "<file>"))), file)
        return
    path = Path(file)
    with _open(path) as stream:
        yield _source(path, stream)


def _open(path: Path) -> BinaryIO:
    try:
        if path.is_dir():
            raise MissingLog(f"{path}: is a directory; give one of the files in it")
        if path.exists() and not path.is_file():  # a pipe or a device has no end and cannot seek
            raise MissingLog(f"{path}: is not a regular file; copy the log to one")
        return path.open("rb")
    except FileNotFoundError as error:
        if _ADDRESS.match(str(path)):
            raise MissingLog(
                f"{path}: is an address, which only `servofd audit` and `servofd trend` read; copy the log to a file"
            ) from error
        raise MissingLog(f"{path}: no such file; give the path of a flight log") from error
    except PermissionError as error:
        raise MissingLog(f"{path}: no permission to read it; chmod +r would give it") from error
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise MissingLog(f"{str(path)!r}: cannot be opened: {reason_of(error)}; give a readable file") from error


def _source(path: Path, file: BinaryIO) -> Source:
    try:
        file.seek(0)
        head = file.read(HEAD_BYTES)
    except OSError as error:
        raise MissingLog(f"{path}: cannot be read: {reason_of(error)}; give a file that can seek") from error
    if not isinstance(head, bytes):
        raise TypeError(f"{path}: a text file object; open it with mode 'rb'")
    if not head:
        raise EmptyLog(f"{path}: the file is empty (0 bytes); was the log copied completely?")
    return Source(path, file, _behind_zeros(file) if head.startswith(_ZEROS) else head)


def _behind_zeros(file: BinaryIO) -> bytes:
    """Bytes behind the zeros that begin a file: what a disk was given before a ground station wrote to it."""
    file.seek(0)
    while block := file.read(_BLOCK):
        if found := block.lstrip(b"\0"):
            return found[:HEAD_BYTES] + file.read(max(HEAD_BYTES - len(found), 0))
    return _ZEROS
