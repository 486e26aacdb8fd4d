"""The compiler, for loops over bytes that numpy cannot do."""

from __future__ import annotations

import sys
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numba
from numba.core.caching import FunctionCache
from numba.core.runtime import rtsys

if TYPE_CHECKING:
    from collections.abc import Callable


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
    made = numba.njit(nogil=True, no_cfunc_wrapper=True, **options)(function)
    with suppress(RuntimeError):  # no writable directory for the cache
        made._cache = _KeptCode(function)
    return made  # type: ignore[no-any-return]
