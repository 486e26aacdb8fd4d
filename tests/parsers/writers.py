"""Files of every kind, written without the code under test: by hand, by scipy, and by h5py."""

from __future__ import annotations

import io
import struct
import zipfile
from collections.abc import Mapping
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.io import savemat

Floats = NDArray[np.float64]

ROWS = 120
TIME_S: Floats = 5.0 + np.arange(ROWS, dtype=np.float64) * 0.02
# Multiples of 2**-10 survive single precision and seven decimals unchanged, so that every format can hold them exactly.
COMMAND: Floats = np.round(np.sin(TIME_S) * 1024) / 4096
POSITION: Floats = np.roll(COMMAND, 3)
FLIGHT = {"time": TIME_S, "de": COMMAND, "de_pos": POSITION}

CODES = {"f8": 0, "f4": 10, "i4": 20, "i2": 30}


def level4(variables: Mapping[str, tuple[str, Floats]], order: str = ">") -> bytes:
    """Level 4 as the flight computer writes it: a header of five integers, the name, the column."""
    machine = 1000 if order == ">" else 0
    parts = []
    for name, (code, values) in variables.items():
        parts.append(struct.pack(order + "5i", machine + CODES[code], len(values), 1, 0, len(name) + 1))
        parts.append(name.encode() + b"\0" + np.asarray(values).astype(order + code).tobytes())
    return b"".join(parts)


def flight_level4(order: str = ">") -> bytes:
    return level4({"time": ("f4", TIME_S), "de": ("f4", COMMAND), "de_pos": ("f8", POSITION)}, order)


def element5(order: str, kind: int, data: bytes) -> bytes:
    """One tagged element of level 5."""
    return struct.pack(order + "2I", kind, len(data)) + data.ljust(-(-len(data) // 8) * 8, b"\0")


def vector5(order: str, name: str, values: Floats, *, kind: int = 9) -> bytes:
    """A column of doubles, as level 5 frames it."""
    return element5(
        order,
        14,
        element5(order, 6, struct.pack(order + "2I", 6, 0))
        + element5(order, 5, struct.pack(order + "2i", len(values), 1))
        + element5(order, 1, name.encode())
        + element5(order, kind, values.astype(order + "f8").tobytes()),
    )


def level5(order: str, *elements: bytes) -> bytes:
    head = b"MATLAB 5.0 MAT-file".ljust(124)
    return head + (b"\x00\x01IM" if order == "<" else b"\x01\x00MI") + b"".join(elements)


def matlab(variables: Mapping[str, Any], *, level: str = "5", compressed: bool = False) -> bytes:
    file = io.BytesIO()
    savemat(file, dict(variables), format=level, do_compression=compressed)  # type: ignore[arg-type]
    content = file.getvalue()
    # Without the time of day that scipy writes: two processes that run the tests must name them alike.
    return content if level == "4" else b"MATLAB 5.0 MAT-file".ljust(116) + content[116:]


def hdf5(variables: Mapping[str, Any], *, userblock: bytes = b"", **options: Any) -> bytes:
    file = io.BytesIO()
    with h5py.File(file, "w", userblock_size=len(userblock)) as h5:
        for name, values in variables.items():
            h5.create_dataset(name, data=values, **options)
    content = file.getvalue()
    return userblock + content[len(userblock) :]


def matlab73(variables: Mapping[str, Floats]) -> bytes:
    block = b"MATLAB 7.3 MAT-file, Platform: GLNXA64, HDF5 schema 1.00 .".ljust(124) + b"\x00\x02IM"
    rows = {"#refs#/a": variables["de"], "flight/weather": np.zeros((3, 4))}
    rows |= {f"flight/{name}": values[np.newaxis] for name, values in variables.items()}
    return hdf5(rows, userblock=block.ljust(512, b"\0"), compression="gzip", shuffle=True)


def raptrs() -> bytes:
    return hdf5(
        {
            "Control/cmdElev_rad": COMMAND[:, np.newaxis],
            "Control/cmdMotor_nd": POSITION,
            "Sensors/Fmu/Time_us": np.rint(TIME_S * 1e6).astype(np.uint64),
            "Sensors/Fmu/Voltage/Input_V": POSITION,
        }
    )


def table(columns: Mapping[str, Any], delimiter: str = ",", *, header: bool = True, end: str = "\n") -> bytes:
    lines = [delimiter.join(columns)] if header else []
    lines += [delimiter.join(str(cell) for cell in row) for row in zip(*columns.values(), strict=True)]
    return (end.join(lines) + end).encode()


def zipped(files: Mapping[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    """An archive."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name), content, method)
    return file.getvalue()
