"""Writing files whole or not at all, and how a file begins."""

from __future__ import annotations

import errno
import re
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from servofd.core.errors import ConfigError

_LONGEST_NAME = 80
"""Characters of a file's name at most."""


def distinct_file_names(names: Sequence[str]) -> list[str]:
    """Make a part of a file name out of each name: short, without separators, and no two the same.

    Examples
    --------
    >>> distinct_file_names(["elevator", "a/b", "a:b", "elevator"])
    ['elevator', 'a_b', 'a_b~2', 'elevator~2']
    """
    used: dict[str, int] = {}
    result = []
    for name in names:
        plain = re.sub(r"[^\w.~-]", "_", name)[:_LONGEST_NAME].lstrip(".") or "_"
        used[plain] = used.get(plain, 0) + 1
        result.append(plain if used[plain] == 1 else f"{plain}~{used[plain]}")
    return result


def beginning(path: Path, most_bytes: int) -> bytes:
    """First bytes of a file; an OSError says why it cannot be read, as of a pipe, which would be waited for."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise OSError(errno.EINVAL, "is not a regular file; copy it to one")
    with path.open("rb") as file:
        return file.read(most_bytes)


def make_folder(folder: Path) -> None:
    """Make a folder for results, if it is not there."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot make this folder: {error.strerror}") from None


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """Give a temporary file to write, and put it in place when the block ends well.

    A second run, an interruption or an error never leaves half a file under the final name.
    """
    target = Path(path).resolve()
    is_replaced = not target.exists() or target.is_file()  # a device or a pipe can only be written to
    try:
        with tempfile.TemporaryDirectory(prefix=".servofd-", dir=target.parent if is_replaced else None) as folder:
            temporary = Path(folder) / f"whole{target.suffix}"
            temporary.touch()
            yield temporary
            if is_replaced:
                temporary.replace(target)
            else:
                target.write_bytes(temporary.read_bytes())
    except OSError as error:
        raise ConfigError(f"{path}: cannot write here: {error.strerror or error}") from None


def write_whole(path: str | Path, content: bytes) -> None:
    """Write a file whole or not at all."""
    with whole_file(path) as temporary:
        temporary.write_bytes(content)
