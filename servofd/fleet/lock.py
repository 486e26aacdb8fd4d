"""One writer at a time: a lock that the system takes back from a process that dies."""

from __future__ import annotations

import errno
import sys
from typing import TYPE_CHECKING, BinaryIO

from servofd.errors import ConfigError

if TYPE_CHECKING:
    from pathlib import Path

_NAME = ".lock"
_TAKEN = (errno.EWOULDBLOCK, errno.EACCES, errno.EDEADLK)


def locked(folder: Path) -> BinaryIO:
    """Take the lock of a folder; closing the file gives it back, and so does the end of the process.

    The file stays: to remove it would let two others have locks on two files of one name.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> with tempfile.TemporaryDirectory() as name, locked(Path(name)):
    ...     locked(Path(name))  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    servofd.errors.ConfigError: ...: another audit writes its results here; wait for it, or choose another folder
    """
    file = (folder / _NAME).open("ab")
    try:
        _lock(file)
    except OSError as error:
        if error.errno in _TAKEN:
            file.close()
            raise ConfigError(
                f"{folder}: another audit writes its results here; wait for it, or choose another folder"
            ) from None
        # A file system that knows no locks: nobody can be kept out.
    return file


def _lock(file: BinaryIO) -> None:
    if sys.platform == "win32":
        import msvcrt

        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
