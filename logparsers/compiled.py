"""The compiler, for loops over bytes that numpy cannot do."""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from enum import Enum
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import Any, Literal

import numpy as np
import platformdirs

try:
    import numba
    from numba.core.caching import FunctionCache
    from numba.core.runtime import rtsys
except ImportError:  # everything runs without it, slowly
    numba = None
    FunctionCache = object


_FAST = {"contract", "nsz", "arcp"}
"""What the compiler may do to sums and products: nothing that moves an infinity, or a limit that is one."""


@cache
def cache_folder() -> Path:
    """Folder in which machine code is kept: the user's own cache, or the one that NUMBA_CACHE_DIR names."""
    return Path(os.environ.get("NUMBA_CACHE_DIR") or platformdirs.user_cache_path("servofd")).absolute()


def has_compiler() -> bool:
    """Whether there is one; without, everything runs as plain Python, slowly."""
    return numba is not None


def made_by() -> str:
    """Compiler and processor that kept machine code is for."""
    from llvmlite.binding import get_host_cpu_name  # type: ignore[import-untyped]

    return f"numba {numba.__version__}, Python {sys.version_info[:3]}, {get_host_cpu_name()}"


if numba is not None:
    with suppress(OSError):  # where that is read-only, the compiler finds another place by itself
        cache_folder().mkdir(parents=True, exist_ok=True)
        if os.access(cache_folder(), os.W_OK):
            numba.config.CACHE_DIR = str(cache_folder())


class _KeptCode(FunctionCache):  # type: ignore[misc]
    """Machine code on disk, which is loaded without what only compiling needs: 0.25 s less for who compiles nothing."""

    def load_overload(self, signature: Any, target: Any) -> Any:  # noqa: ANN401 - numba's own
        """What was kept of a function; None if it is to be compiled."""
        rtsys.initialize(target)  # arrays that functions make
        with self._guard_against_spurious_io_errors():
            found = self._load_overload(signature, target)
        if found is None:
            _load_arrays()
        return found

    def _index_key(self, signature: Any, codegen: Any) -> Any:  # noqa: ANN401 - numba's own
        """Under what a function is kept: numba looks at its own file alone, not at what it takes from others."""
        digest = hashlib.sha256()
        for part in fixed_in(self._py_func):
            digest.update(part)
        return (*super()._index_key(signature, codegen), digest.hexdigest())


def _load_arrays() -> None:
    """Load numba's loops over arrays without scipy.linalg, whose presence they would load it to find out.

    A function with a matrix product still loads it, when it is compiled or called: 0.2 s that others save.
    """
    blas = "scipy.linalg.cython_blas"
    if blas in sys.modules:
        return
    sys.modules[blas] = None  # type: ignore[assignment]
    try:
        from numba.np import arraymath
    finally:
        del sys.modules[blas]
    arraymath._HAVE_BLAS = True


def compiled(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:  # noqa: ANN401 - numba's own
    """Compile; keep the machine code on disk where there is a place to keep it.

    `function`: of integers, tuples and arrays only.
    """
    if numba is None:
        return function
    made = numba.njit(nogil=True, no_cfunc_wrapper=True, **options)(function)
    with suppress(RuntimeError):  # no writable directory for the cache
        made._cache = _KeptCode(function)
    return made  # type: ignore[no-any-return]


def fixed_in(function: Callable[..., Any], seen: set[object] | None = None) -> Iterator[bytes]:
    """Yield what machine code of a function has fixed: its code, that of all it calls, and the constants they name.

    Examples
    --------
    >>> def turned(deg):
    ...     return FULL_DEG - deg
    >>> FULL_DEG = 360.0
    >>> [part for part in fixed_in(turned) if part.startswith(b"FULL_DEG")]
    [b'FULL_DEG=360.0']
    """
    seen = set() if seen is None else seen
    code = function.__code__
    if code in seen:
        return
    seen.add(code)
    yield code.co_code
    for constant in filter(_is_plain, code.co_consts):
        yield repr(constant).encode()
    for name in code.co_names:
        value = function.__globals__.get(name)
        value = getattr(value, "py_func", value)
        if isinstance(value, FunctionType):
            yield from fixed_in(value, seen)
        elif isinstance(value, np.ndarray):
            yield name.encode() + value.tobytes()
        elif isinstance(value, type) and issubclass(value, Enum):
            yield f"{name}={list(value)}".encode()
        elif _is_plain(value):
            yield f"{name}={value!r}".encode()


def _is_plain(value: object) -> bool:
    """Whether a value prints the same in every run."""
    if isinstance(value, tuple):
        return all(_is_plain(each) for each in value)
    return value is None or isinstance(value, (bool, int, float, complex, str, bytes, np.generic, Enum))


def compile_steps(*, kind: Literal["outer", "inlined"]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Compile a function of the stepper: the outer one, or one that becomes part of its caller.

    No reference counting: nothing in it allocates, and it would take half of the time (measured). What only other
    compiled functions call needs no door for Python, which takes as long to compile as the function.
    """

    def made(function: Callable[..., Any]) -> Callable[..., Any]:
        options: dict[str, Any] = {"error_model": "numpy", "fastmath": _FAST, "_nrt": False}
        if kind == "inlined":
            options |= {"no_cpython_wrapper": True, "forceinline": True}
        return compiled(function, **options)

    return made
