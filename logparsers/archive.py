"""Logs that were packed: inflated to a file of their own, which is gone when they are read, never into memory."""

from __future__ import annotations

import bz2
import gzip
import lzma
import os
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import IO, Any, BinaryIO, Final, cast

from logparsers.errors import UnreadableLog
from logparsers.records import Damage

LIMIT_VARIABLE: Final = "LOGPARSERS_MOST_UNPACKED_MB"
MOST_UNPACKED_MB: Final = 1024
"""Of one log, unless `LIMIT_VARIABLE` in the environment says otherwise: deflate turns 3 MB of zeros into 3 GB."""

IN_MEMORY_MB: Final = 1024
"""Of all that is compressed within one file of MATLAB or HDF5, in the same way."""

MOST_MEMBERS: Final = 10_000
"""Files in an archive at most."""
BLOCK: Final = 1 << 20
"""Bytes that are inflated at once."""

STREAMS: Final[dict[bytes, Callable[[BinaryIO], Any]]] = {
    b"\x1f\x8b": lambda file: gzip.GzipFile(fileobj=file),
    b"BZh": bz2.BZ2File,
    b"\xfd7zXZ\0": lzma.LZMAFile,
}
ZIP: Final = (b"PK\x03\x04", b"PK\x05\x06")
BROKEN: Final = (OSError, EOFError, zlib.error, lzma.LZMAError, zipfile.BadZipFile, RuntimeError, NotImplementedError,
                 ValueError, MemoryError)  # fmt: skip

Opener = Callable[[], IO[bytes]]


def is_packed(head: bytes) -> bool:
    """Tell an archive from a log by its first bytes."""
    return head.startswith((*STREAMS, *ZIP))


def members(file: BinaryIO, path: Path) -> list[tuple[str, Opener]]:
    """List what an archive holds: the name of each file within it, and what opens it."""
    file.seek(0)
    head = file.read(8)
    file.seek(0)
    for magic, stream in STREAMS.items():
        if head.startswith(magic):
            return [("", partial(stream, file))]
    try:
        archive = zipfile.ZipFile(file)
        infos = [info for info in archive.infolist() if not info.is_dir() and not _is_hidden(info.filename)]
    except BROKEN as error:
        raise _broken(path, error) from error
    if len(infos) > MOST_MEMBERS:
        raise UnreadableLog(f"{path}: an archive of {len(infos)} files; unpack it, and give the folder")
    for info in infos:
        check_size(path, info.file_size)
    return [(info.filename, partial(archive.open, info)) for info in infos]


def beginning(unpack: Opener, path: Path, size: int) -> bytes:
    """First bytes of a packed file."""
    try:
        with unpack() as packed:
            return packed.read(size)
    except BROKEN as error:
        raise _broken(path, error) from error


@contextmanager
def inflated(unpack: Opener, path: Path) -> Iterator[tuple[BinaryIO, tuple[Damage, ...]]]:
    """Inflate to a temporary file, up to the limit; of a download that stopped, what is there."""
    with tempfile.TemporaryFile(prefix="servofd-") as target:
        size = 0
        damage: tuple[Damage, ...] = ()
        try:
            with unpack() as packed:
                while block := packed.read1(BLOCK):  # type: ignore[attr-defined]
                    size += len(block)
                    check_size(path, size)
                    target.write(block)
        except BROKEN as error:
            if not size or not isinstance(error, EOFError):
                raise _broken(path, error) from error
            damage = (Damage("truncated", f"the archive is cut: {size} bytes could be unpacked"),)
        target.flush()
        yield cast("BinaryIO", target), damage


def _is_hidden(name: str) -> bool:
    return any(part.startswith((".", "__MACOSX")) for part in name.split("/"))


def check_size(path: Path, size: int, most_mb: int = MOST_UNPACKED_MB) -> None:
    """Refuse what unpacks to more than allowed.

    `size`: so far, or as its header promises [bytes].
    """
    text = os.environ.get(LIMIT_VARIABLE, "")
    limit_mb = int(text) if text.isdecimal() else most_mb
    if size > limit_mb << 20:
        raise UnreadableLog(
            f"{path}: unpacks to more than {limit_mb} MB; unpack it yourself, or set {LIMIT_VARIABLE} higher"
        )


def _broken(path: Path, error: BaseException) -> UnreadableLog:
    said = (str(error) or type(error).__name__).splitlines()[0][:120]
    return UnreadableLog(f"{path}: a broken or encrypted archive ({said}); unpack it, or copy it again")
