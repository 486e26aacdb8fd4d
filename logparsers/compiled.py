"""The compiler, for loops over bytes that numpy cannot do."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numba

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["compiled"]


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
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
        return numba.njit(cache=True, nogil=True)(function)  # type: ignore[no-any-return]
    except RuntimeError:  # no writable directory for the cache
        return numba.njit(nogil=True)(function)  # type: ignore[no-any-return]
