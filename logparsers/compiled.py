"""The compiler, for loops over bytes that numpy cannot do."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import numba

if TYPE_CHECKING:
    from collections.abc import Callable


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


_load_arrays()


def compiled(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:  # noqa: ANN401 - numba's own
    """Compile; keep the machine code on disk where there is a place to keep it.

    Parameters
    ----------
    function : callable
        Of integers, tuples and arrays only.

    Examples
    --------
    >>> @compiled
    ... def twice(n):
    ...     return 2 * n
    >>> twice(21)
    42
    """
    try:
        return numba.njit(cache=True, nogil=True, **options)(function)  # type: ignore[no-any-return]
    except RuntimeError:  # no writable directory for the cache
        return numba.njit(nogil=True, **options)(function)  # type: ignore[no-any-return]
