"""What other tools export of a log: by mavlogdump itself, and as Mission Planner does it, from what pymavlink reads."""

from __future__ import annotations

import io
import os
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path
from typing import Any, cast

import numpy as np
from pymavlink import DFReader
from scipy.io import savemat

__all__ = ["mavlogdump", "mavlogdump_mat", "mission_planner_mat", "ulog2csv"]


@cache
def mavlogdump(content: bytes, *options: str, suffix: str = ".bin") -> bytes:
    """What mavlogdump prints about a log; ``OUT`` among the options is a file that it writes instead."""
    with tempfile.TemporaryDirectory() as folder:
        log, out = Path(folder, f"flight{suffix}"), Path(folder, "out")
        log.write_bytes(content)
        words = [str(out) if word == "OUT" else word for word in options]
        command = [sys.executable, "-m", "pymavlink.tools.mavlogdump", *words, str(log)]
        env = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
        told = subprocess.run(command, capture_output=True, check=True, env=env).stdout
        return out.read_bytes() if out.exists() else told


def mavlogdump_mat(content: bytes, *options: str) -> bytes:
    return mavlogdump(content, "--format", "mat", "--mat_file", "OUT", *options)


@cache
def ulog2csv(content: bytes, topic: str) -> bytes:
    """The table that pyulog's program writes of a topic."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder, "flight.ulg")
        log.write_bytes(content)
        command = [sys.executable, "-c", "from pyulog.ulog2csv import main; main()", str(log)]
        subprocess.run(command, capture_output=True, check=True, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"})
        return Path(folder, f"flight_{topic}.csv").read_bytes()


def mission_planner_mat(content: bytes) -> bytes:
    """A matrix of each message behind the numbers of its lines, and cells with what its columns are called."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "flight.bin")
        path.write_bytes(content)
        log = DFReader.DFReader_binary(str(path))
        rows: dict[str, list[list[float]]] = {}
        labels: dict[str, list[str]] = {}
        parameters: dict[str, float] = {}
        said: list[np.ndarray[Any, Any]] = []
        line = 0
        while (message := log.recv_msg()) is not None:
            line += 1
            kind = message.get_type()
            if kind == "FMT":
                labels[message.Name] = ["LineNo", *message.Columns.split(",")]
            elif kind == "PARM":
                parameters[message.Name] = message.Value
            else:
                if kind == "MSG":
                    said.append(_cell(["MSG", float(message.TimeUS), message.Message]))
                values = [getattr(message, column) for column in labels[kind][1:]]
                rows.setdefault(kind, []).append(
                    [float(line), *(v if isinstance(v, int | float) else 0.0 for v in values)]
                )
        log.close()
    file: dict[str, Any] = {f"{name}_label": _cell(columns) for name, columns in labels.items() if name != "PARM"}
    file |= {name: np.array(values) for name, values in rows.items()}
    file["MSG1"] = _cell(said).T
    file["PARM"] = np.hstack([_cell(sorted(parameters)), _cell([parameters[name] for name in sorted(parameters)])])
    out = io.BytesIO()
    savemat(cast("Any", out), file)
    return out.getvalue()


def _cell(items: list[Any]) -> np.ndarray[Any, Any]:
    cell = np.empty((len(items), 1), dtype=object)
    for place, item in enumerate(items):
        cell[place, 0] = item
    return cell
