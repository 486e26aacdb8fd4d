"""Writing files whole or not at all."""

from __future__ import annotations

import os
import tempfile
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from servofd.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["whole_file", "write_whole"]


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """Give a temporary file to write, and put it in place when the block ends well.

    A second run, an interruption or an error never leaves half a file under the final name.

    Raises
    ------
    ConfigError
        If the folder does not exist or cannot be written to.
    """
    target = Path(path)
    try:
        handle, name = tempfile.mkstemp(prefix=f".{target.name}.", suffix=target.suffix, dir=target.parent)
    except OSError as error:
        raise ConfigError(f"{path}: cannot write here: {error.strerror}") from None
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o666 & ~_umask())
        temporary.replace(target)
    except OSError as error:
        raise ConfigError(f"{path}: cannot write here: {error.strerror or error}") from None
    finally:
        temporary.unlink(missing_ok=True)


def write_whole(path: str | Path, content: bytes) -> None:
    """Write a file whole or not at all.

    Examples
    --------
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_whole(Path(folder) / "a.txt", b"done")
    ...     (Path(folder) / "a.txt").read_bytes()
    b'done'
    """
    with whole_file(path) as temporary:
        temporary.write_bytes(content)


def _umask() -> int:
    """Permissions that the user takes away from new files; reading them means setting them."""
    current = os.umask(0)
    os.umask(current)
    return current
