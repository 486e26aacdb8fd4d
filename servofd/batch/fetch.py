"""Logs at an address, brought to this machine for as long as they are read."""

from __future__ import annotations

import shutil
import tempfile
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from servofd.batch.find import is_address
from servofd.core.errors import ConfigError, needs

if TYPE_CHECKING:
    from collections.abc import Iterator


@contextmanager
def fetched(path: str) -> Iterator[str]:
    """Give a local file: the log itself, or a copy of the same name that is gone afterwards.

    Examples
    --------
    >>> with fetched("a.csv") as local:
    ...     local
    'a.csv'
    """
    if not is_address(path):
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="servofd-") as folder:
        target = Path(folder, Path(path).name or "log")
        needs("fsspec")
        import fsspec

        try:
            with fsspec.open(path, "rb") as remote, target.open("wb") as file:
                shutil.copyfileobj(remote, file)
        except (OSError, ImportError, ValueError) as error:
            raise ConfigError(f"{path}: cannot be fetched: {error}") from None
        yield str(target)
