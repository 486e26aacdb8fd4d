"""Which logs there are: files, folders, patterns and addresses, recognised by their content, and brought here."""

from __future__ import annotations

import glob
import io
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

import logparsers
from logparsers import EmptyLog, LogError, TableLayout
from logparsers.detect import detect
from logparsers.source import HEAD_BYTES, heads
from servofd.core.errors import ConfigError, needs, without

META_FILE = "fleet.json"
"""Marks a folder of results, in which no logs are looked for."""

_OWN_PAGE = b'<meta name="generator" content="servofd">'
"""In the head of every page of results."""
_MAGIC = frozenset("*?[")
_TABLE_HEAD_BYTES = 65_536
"""Room for a header line and some rows of any table."""


_File = tuple[str, int, Callable[[str], Iterable[bytes]]]
"""Name, size [bytes], and what gives the first bytes of it, or of each file in it if it is an archive."""


class LogSource(NamedTuple):
    """One log: a file, or an address that fsspec opens."""

    path: str
    size_bytes: int
    """0 if it is not known."""


class Skipped(NamedTuple):
    """A file that is no log, and why."""

    path: str
    reason: str


class Found(NamedTuple):
    """What there is to do."""

    logs: tuple[LogSource, ...]
    skipped: tuple[Skipped, ...]
    problems: tuple[str, ...]
    """What is wrong with inputs that gave no log, a line each."""


def find_logs(inputs: Sequence[str], layout: TableLayout | None = None) -> Found:
    """Find all logs, in the order of the inputs, by name within each; none twice.

    A file that is named is taken whatever it is. Files of folders, patterns and addresses are recognised by content;
    hidden ones, and folders of results, are passed over.

    `inputs`: files, folders, patterns such as ``"2026/**/*.bin"``, addresses such as ``"s3://bucket/logs"``. `layout`:
    how text tables are read.

    Examples
    --------
    >>> [log.path for log in find_logs(["sample_logs/faser_hea*flight.mat"]).logs]
    ['sample_logs/faser_healthy_flight.mat']
    """
    logs: dict[str, LogSource] = {}
    skipped: dict[str, Skipped] = {}
    problems = []
    for text in inputs:
        try:
            every = list(_found(text, layout))
        except ConfigError as error:
            problems.append(str(error))
            continue
        found = [one for one in every if isinstance(one, LogSource)]
        passed = [one for one in every if isinstance(one, Skipped)]
        if not found:
            problems.append(f"{text}: {_nothing(text, passed)}")
        logs |= {log.path if "://" in log.path else os.path.normpath(log.path): log for log in found}
        skipped |= {one.path: one for one in passed}
    if not logs:
        raise ConfigError("; ".join(problems) or "no log was named")
    return Found(tuple(logs.values()), tuple(skipped.values()), tuple(problems))


def kind_of(text: str) -> Literal["address", "pattern", "folder", "file"]:
    """What fsspec opens (``s3://bucket/flight.bin``), several files, or one name on this machine, even of nothing."""
    if "://" in text:
        return "address"
    if _MAGIC & set(text) and not os.path.lexists(text):
        return "pattern"
    try:
        return "folder" if Path(text).is_dir() else "file"
    except OSError:  # no file can have this name
        return "file"


def _found(text: str, layout: TableLayout | None) -> Iterator[LogSource | Skipped]:
    """Logs, and what is none; a page of results that was written beside the logs last time is neither."""
    kind = kind_of(text)
    if kind == "file":
        yield LogSource(text, _size_bytes(text))
        return
    for name, size_bytes, heads_of in _remote_files(text) if kind == "address" else _local_files(text, kind):
        reason = _why_no_log(name, heads_of, layout)
        if not reason:
            yield LogSource(name, size_bytes)
        elif not (name.endswith(".html") and any(_OWN_PAGE in head for head in heads_of(name))):
            yield Skipped(name, reason)


def _local_files(text: str, kind: str) -> Iterator[_File]:
    """Files of a folder, or those that fit a pattern and those in folders that do."""
    matches = [text]
    if kind == "pattern":
        matches = sorted(glob.glob(text, recursive=True))  # noqa: PTH207 - Path.glob takes no absolute patterns
    for match in matches:
        for name in _walked(match) if Path(match).is_dir() else [match]:
            yield name, _size_bytes(name), partial(heads, size=_TABLE_HEAD_BYTES)


def _nothing(text: str, skipped: list[Skipped]) -> str:
    """Why an input gave no log."""
    kind = kind_of(text)
    if not skipped and kind == "pattern":
        return "no file fits this pattern; put it in quotes, and ** stands for any folders"
    if not skipped:
        return f"this {kind} holds no file; give one that holds flight logs"
    first = skipped[0]
    return f"this {kind} holds no log: {len(skipped)} files passed over, the first {first.path}: {first.reason}"


def _walked(folder: str) -> Iterator[str]:
    """Files below a folder, by name; hidden ones and results left out."""

    def refuse(error: OSError) -> None:
        raise ConfigError(f"{error.filename}: cannot read this folder: {error.strerror}")

    for parent, folders, names in os.walk(folder, onerror=refuse):
        if META_FILE in names:
            folders.clear()
            continue
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        yield from (str(Path(parent, name)) for name in sorted(names) if not name.startswith("."))


def _why_no_log(name: str, heads_of: Callable[[str], Iterable[bytes]], layout: TableLayout | None) -> str:
    """Why a file is no log, or nothing; an archive is one if it holds one."""
    try:
        reasons = [_why_no_head(head, name, layout) for head in heads_of(name)]
    except EmptyLog:
        return "empty"
    except LogError as error:
        return str(error).removeprefix(f"{name}: ")
    except OSError as error:
        return f"cannot be read: {error.strerror or error}"
    return min(reasons, key=bool, default="empty")


def _why_no_head(head: bytes, name: str, layout: TableLayout | None) -> str:
    """Text is a log if its first lines are a table of flight data; one with something wrong in it is for the audit."""
    if not head:
        return "empty"
    try:
        reader = detect(head[:HEAD_BYTES], name)
    except LogError as error:
        return str(error).removeprefix(f"{name}: ")
    if reader.__name__ != "read_table":
        return ""
    whole_lines = head[: head.rfind(b"\n") + 1] or head
    try:
        logparsers.read_all(io.BytesIO(whole_lines), layout)
    except LogError as error:
        times = {layout.time} if layout else {"time_s"}
        header = whole_lines.lstrip().split(b"\n")[0].decode("utf-8", "replace")
        if times & set(re.split(r"[\s,;]+", header)) or (layout and layout.columns):
            return ""
        return str(error).removeprefix("<file>: ")
    return ""


def _size_bytes(name: str) -> int:
    try:
        return Path(name).stat().st_size
    except OSError:
        return 0


def _remote_files(address: str) -> Iterator[_File]:
    """Files at an address: one, those of a folder, or those that fit a pattern."""
    try:
        import fsspec
        from fsspec.core import url_to_fs
    except ImportError:
        raise ConfigError(f"{address}: {without('fsspec')}") from None
    try:
        system, path = url_to_fs(address)
        if _MAGIC & set(path):
            infos = system.glob(path, detail=True)
        elif system.isdir(path):
            infos = system.find(path, detail=True)
        else:
            infos = {path: system.info(path)}
    except FileNotFoundError:
        raise ConfigError(f"{address}: nothing is there") from None
    except (ImportError, ValueError, OSError) as error:
        raise ConfigError(f"{address}: cannot be opened: {error}") from None

    def remote_heads(name: str) -> list[bytes]:
        with fsspec.open(name, "rb") as file:
            return heads(file, _TABLE_HEAD_BYTES)

    for name, info in sorted(infos.items()):
        hidden = Path(name).name.startswith(".")
        if info.get("type") == "file" and not hidden:
            yield system.unstrip_protocol(name), int(info.get("size") or 0), remote_heads


@contextmanager
def fetched(path: str) -> Iterator[str]:
    """Give a local file: the log itself, or a copy of the same name that is gone afterwards."""
    if kind_of(path) != "address":
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
