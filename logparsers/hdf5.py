"""HDF5 through h5py: every plausible array of numbers, by its path."""

from __future__ import annotations

import re
import struct
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from logparsers.archive import IN_MEMORY_MB, check_size
from logparsers.errors import UnreadableLog, decoding
from logparsers.source import Source

if TYPE_CHECKING:
    import h5py


SIGNATURE = re.compile(rb"\x89HDF\r\n\x1a\n")
TREE_HEAD = struct.Struct("<4sBBHQQ")

BEST_COMPRESSION = 1100
"""Deflate never shrinks data further than 1032 times: a data set that claims more is forged, or was never written."""


def arrays(source: Source) -> dict[str, NDArray[Any]]:
    """Read all numeric vectors and matrices.

    Result: by path, ``"/Control/cmdElev_rad"``, in the type and shape of the file.
    """
    try:
        import h5py
    except ImportError:
        raise UnreadableLog(
            f'{source.path}: this needs h5py, which is not installed: pip install "servofd[hdf5]"'
        ) from None

    found: dict[str, NDArray[Any]] = {}
    sizes = [0]

    def visit(name: str, item: object) -> None:
        cell = name.startswith("#")  # MATLAB 7.3 keeps the contents of cells in #refs#
        if isinstance(item, h5py.Dataset) and not cell and _is_numeric(item):
            sizes.append(sizes[-1] + item.nbytes)
            check_size(source.path, sizes[-1], IN_MEMORY_MB)
            found["/" + name] = np.asarray(item[()])

    with decoding(source.path, "HDF5 file"):
        if _has_endless_tree(source.mapped().data):
            raise UnreadableLog(f"{source.path}: not a sound HDF5 file: its index runs in circles; copy it again")
        with h5py.File(source.file, "r") as file:
            file.visititems(visit)
    return found


def _has_endless_tree(content: memoryview) -> bool:
    """Tell whether a search tree leads back into itself: the library would follow it for ever.

    A node is ``TREE``, type, level, number of entries, left and right sibling, then keys and children in turn. Siblings
    are of one level, children of the level below; those of data (type 1) have keys of any size and are not followed.
    """
    signature = SIGNATURE.search(content)
    base = signature.start() if signature else 0
    right: dict[int, int] = {}
    for found in re.finditer(rb"TREE[\0\1]", content):
        at = found.start()
        if at + TREE_HEAD.size > len(content):
            break
        _, kind, level, entries, _, right[at - base] = TREE_HEAD.unpack_from(content, at)
        if kind == 0 and level:
            pairs = content[at + TREE_HEAD.size : at + TREE_HEAD.size + 16 * entries]
            for _, child in struct.iter_unpack("<2Q", pairs[: len(pairs) // 16 * 16]):
                below = bytes(content[base + child : base + child + 6])
                if below[:4] == b"TREE" and below[5:6] != bytes((level - 1,)):
                    return True
    ended: set[int] = set()
    for start in right:
        chain: set[int] = set()
        node = start
        while node in right and node not in ended:
            if node in chain:
                return True
            chain.add(node)
            node = right[node]
        ended |= chain
    return False


def _is_numeric(data: h5py.Dataset) -> bool:
    """No text, no references, nothing kept in other files, nothing that claims more than was stored."""
    if data.dtype.kind not in "iuf" or "MATLAB_empty" in data.attrs or data.external or data.is_virtual:
        return False
    if data.attrs.get("MATLAB_class") == b"char" or not data.shape:
        return False
    return bool(data.nbytes <= BEST_COMPRESSION * data.id.get_storage_size())
