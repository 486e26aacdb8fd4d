"""A folder of results: four Parquet data sets that grow part by part, so that a run can be broken off and resumed.

One row per log, one per log and surface or axis, one per fault.
"""

from __future__ import annotations

import errno
import json
import re
import sys
import time
import uuid
from collections.abc import Mapping
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, BinaryIO, Self

from servofd.batch.find import META_FILE, LogSource
from servofd.batch.key import content_key
from servofd.core.errors import ConfigError
from servofd.core.files import whole_file, write_whole
from servofd.version import __version__

if TYPE_CHECKING:
    import pyarrow as pa

    from servofd.fleets.run import JudgedLog


def _all(kind: str, *names: str) -> dict[str, str]:
    return dict.fromkeys(names, kind)


_LOG = {**_all("string", "content", "path", "run"), "start_utc": "time"}
TABLES: Mapping[str, Mapping[str, str]] = MappingProxyType(
    {
        "faults": {
            **_LOG,
            **_all("string", "surface", "kind", "level"),
            **_all("double", "start_s", "alarm_s", "end_s", "probability"),
            **_all("string", "parameters", "alternatives"),
        },
        "surfaces": {
            **_LOG,
            "duration_s": "double",
            **_all("string", "surface", "status", "reason", "servo", "threshold_kind"),
            **_all("double", "threshold_deg", "residual_mean_deg", "residual_std_deg", "residual_max_abs_deg"),
            **_all("double", "simulation_error_rms_deg", "false_alarms_per_hour"),
            **_all("int64", "faults", "suspicions"),
        },
        "axes": {
            **_LOG,
            "duration_s": "double",
            **_all("string", "axis", "status", "reason", "members"),
            **_all("double", "lost_share", "offset_us", "since_s", "judged_share"),
        },
        "logs": {
            **_LOG,
            "size_bytes": "int64",
            "format": "string",
            "duration_s": "double",
            "not_judged": "string",
            "damage": "int64",
            "document": "string",
        },
    }
)
"""Columns and their kinds. A log is done when it stands in ``logs``, which is therefore written last."""


def rows(judged: JudgedLog) -> dict[str, list[dict[str, Any]]]:
    """Rows of one log for each table."""
    tables: dict[str, list[dict[str, Any]]] = {name: [] for name in TABLES}
    for run in judged.rows:
        document, start = run["document"], run["document"].get("start_utc")
        log = {name: document.get(name) for name in ("path", "run", "duration_s")}
        log |= {"content": judged.content, "start_utc": datetime.fromisoformat(start) if start else None}
        own = {"size_bytes": judged.source.size_bytes, "not_judged": run["not_judged"] or None}
        own |= {"damage": len(document["damage"]), "document": json.dumps(document)}
        tables["logs"].append(document | log | own)
        for name, axis in document.get("axes", {}).items():
            tables["axes"].append(axis | log | {"axis": name, "members": ", ".join(axis["members"])})
        for name, surface in document["surfaces"].items():
            sizes = {f"residual_{key}": size for key, size in (surface["residual"] or {}).items()}
            sizes |= {f"threshold_{key}": value for key, value in surface["threshold"].items()}
            counts = {level: len(surface[level]) for level in ("faults", "suspicions")}
            tables["surfaces"].append(surface | log | sizes | counts | {"surface": name})
            for level in counts:
                for fault in surface[level]:
                    parameters, others = json.dumps(fault["parameters"]), ", ".join(fault["alternatives"])
                    text = {"level": level.removesuffix("s"), "parameters": parameters, "alternatives": others}
                    tables["faults"].append(fault | log | text | {"surface": name})
    return tables


def to_arrow(name: str, content: list[dict[str, Any]]) -> pa.Table:
    """Rows as an Arrow table with the columns of `TABLES`; names of files that are no UTF-8 as Python writes them."""
    import pyarrow as pa

    kinds = {"string": pa.string(), "double": pa.float64(), "int64": pa.int64(), "time": pa.timestamp("us", tz="UTC")}
    schema = pa.schema([(column, kinds[kind]) for column, kind in TABLES[name].items()])

    def plain(value: object) -> object:
        return value.encode("utf-8", "backslashreplace").decode() if isinstance(value, str) else value

    return pa.Table.from_pylist([{key: plain(row.get(key)) for key in TABLES[name]} for row in content], schema=schema)


_SCHEMA = "servofd.fleets/1"
_EARLIER = "earlier"
_KEY = re.compile(r"\w+")  # it names a folder
_LOGS_PER_PART = 64
"""Logs in a file of each table at most."""
_SECONDS_PER_PART = 10.0
"""A thousand quick logs give sixteen files per table; a run that is killed loses the work of these seconds at most."""


class FleetStore:
    """Results of many logs, all judged with the same aircraft and options by the same version.

    Whoever has it is the only writer of the folder until the end of the ``with`` block, which writes what was added.
    Results of another aircraft file, other options or another version are moved into the folder ``earlier``, and come
    back when they are asked for again.

    `folder`: made if it does not exist. `key`: of the `servofd.batch.key.Job`.
    """

    def __init__(self, folder: Path, key: str) -> None:
        self.folder = folder
        self._lock = locked(folder)
        self._waiting: dict[str, list[dict[str, Any]]] = {name: [] for name in TABLES}
        self._sizes: dict[int, set[str]] = {}
        self._written_s = time.monotonic()
        try:
            self.set_aside = _prepared(folder, key)
            """How many logs were judged otherwise, and are in ``earlier`` now."""
            for row in read_table(folder, "logs", ["content", "size_bytes"]):
                if row["content"]:
                    self._sizes.setdefault(row["size_bytes"], set()).add(row["content"])
        except BaseException:
            self._lock.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        try:
            self.flush()
        finally:
            self._lock.close()

    def done(self, source: LogSource) -> bool:
        """Whether a log with these bytes has been judged; read only if there is one of the same size."""
        known = self._sizes.get(source.size_bytes)
        with suppress(OSError):
            return content_key(source.path) in known if known else False
        return False

    def add(self, judged: JudgedLog) -> bool:
        """Keep what became of a log; False if one with the same bytes is there already.

        What could not even be read, or killed its process, is kept without a digest and tried again next time.
        """
        known = self._sizes.setdefault(judged.source.size_bytes, set())
        if judged.content and judged.content in known:
            return False
        if judged.content:
            known.add(judged.content)
        for name, some in rows(judged).items():
            self._waiting[name] += some
        if len(self._waiting["logs"]) >= _LOGS_PER_PART or time.monotonic() - self._written_s > _SECONDS_PER_PART:
            self.flush()
        return True

    def flush(self) -> None:
        """Write what has been added since."""
        import pyarrow.parquet as pq

        if not self._waiting["logs"]:
            return
        part = f"part-{uuid.uuid4().hex}.parquet"
        for name, content in self._waiting.items():
            with whole_file(self.folder / name / part) as temporary:
                pq.write_table(to_arrow(name, content), temporary, write_page_checksum=True)
        self._waiting = {name: [] for name in TABLES}
        self._written_s = time.monotonic()

    def forget_not_judged(self) -> None:
        """Take out the rows of logs that are tried again."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        for path in sorted((self.folder / "logs").glob("*.parquet")):
            table, rows = _read_part(path)
            kept = table.filter(pa.array([bool(row["content"]) for row in rows], pa.bool_()))
            if len(kept) < len(table):
                with whole_file(path) as temporary:
                    pq.write_table(kept, temporary, write_page_checksum=True)


def read_table(folder: Path, name: str, columns: list[str] | None = None) -> list[dict[str, Any]]:
    """Rows of one table of a folder of results."""
    return [row for path in sorted((folder / name).glob("*.parquet")) for row in _read_part(path, columns)[1]]


def _read_part(path: Path, columns: list[str] | None = None) -> tuple[pa.Table, list[dict[str, Any]]]:
    """One file of a table, and its rows; damage is found by the check-sums of its pages."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(path, columns=columns, page_checksum_verification=True)
        return table, table.to_pylist()
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        reason = str(error).splitlines()[0]
        raise ConfigError(f"{path}: damaged ({reason}); remove it, and its logs are judged again") from None


def read_logs(folder: Path) -> list[dict[str, Any]]:
    """All logs of a folder of results, by path and run: ``document`` as in servofd.audit/1, and ``not_judged``."""
    meta = folder / META_FILE
    if not meta.is_file():
        raise ConfigError(f"{folder}: no results of many logs; make them with servofd audit LOGS/ -o {folder}")
    _read_meta(meta)
    kept = read_table(folder, "logs", ["not_judged", "content", "document"])
    return [{k: json.loads(v) if k == "document" else v or "" for k, v in row.items()} for row in kept]


def _prepared(folder: Path, key: str) -> int:
    """Make the folder ready for the results of one job; gives how many of another were set aside."""
    meta = folder / META_FILE
    set_aside = 0
    try:
        if meta.exists():
            before = _read_meta(meta)["job"]
            if before != key:
                set_aside = len({row["content"] for row in read_table(folder, "logs", ["content"])})
                _move(folder, folder / _EARLIER / before)
        elif any(folder.glob("*/*.parquet")):
            raise ConfigError(f"{folder}: holds Parquet files that servofd did not write; choose another folder")
        earlier = folder / _EARLIER / key
        if earlier.is_dir():
            _move(earlier, folder)
        for name in TABLES:
            (folder / name).mkdir(exist_ok=True)
        # Parts that a killed run wrote without the logs they belong to; those logs are judged again.
        whole = {path.name for path in (folder / "logs").glob("*.parquet")}
        for path in (path for name in TABLES for path in (folder / name).glob("*.parquet")):
            if path.name not in whole:
                path.unlink()
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be written to: {error.strerror}") from None
    write_whole(meta, (json.dumps({"schema": _SCHEMA, "servofd": __version__, "job": key}, indent=2) + "\n").encode())
    return set_aside


def _read_meta(meta: Path) -> dict[str, str]:
    try:
        content = json.loads(meta.read_text(encoding="utf-8"))
        if content["schema"] == _SCHEMA and _KEY.fullmatch(content["job"]):
            return dict(content)
        schema = str(content["schema"])
    except (ValueError, KeyError, TypeError, RecursionError):
        raise ConfigError(f"{meta}: is not what servofd writes; choose another folder") from None
    forms = f"holds results of the form {schema}, this version knows {_SCHEMA}"
    raise ConfigError(f"{meta.parent}: {forms}; choose another folder")


def _move(source: Path, target: Path) -> None:
    target.mkdir(parents=True, exist_ok=True)
    for name in TABLES:
        if (source / name).is_dir():
            (source / name).rename(target / name)


_NAME = ".lock"
_TAKEN = (errno.EWOULDBLOCK, errno.EACCES, errno.EDEADLK)


def locked(folder: Path) -> BinaryIO:
    """Make a folder, and take its lock; closing the file gives it back, and so does the end of the process."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # The file stays: to remove it would let two others have locks on two files of one name.
        file = (folder / _NAME).open("ab")
    except (FileExistsError, NotADirectoryError):
        raise ConfigError(f"{folder}: is a file; results of many logs go to a folder") from None
    except OSError as error:
        raise ConfigError(f"{folder}: cannot make this folder: {error.strerror}") from None
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in _TAKEN:
            file.close()
            other = "another audit writes its results here; wait for it, or choose another folder"
            raise ConfigError(f"{folder}: {other}") from None
        # A file system that knows no locks: other processes cannot be kept out.
    return file
