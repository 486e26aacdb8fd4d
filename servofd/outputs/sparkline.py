"""A residual against its threshold, in one line of a terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

_BELOW, _ABOVE = "▁▂▃▄", "▅▆▇█"
_WIDTH = 64


def sparkline(shares: Sequence[float | None]) -> str:
    """Largest share of the threshold in each part of a flight, as blocks: the lower four below it, the upper above.

    Parameters
    ----------
    shares : sequence of float or None
        Residual over threshold; None where nothing was judged.

    Examples
    --------
    >>> sparkline([0.1, 0.3, None, 0.99, 1.0, 1.6, 9.0])
    '▁▂·▄▅▇█'
    """
    step = max(1, -(-len(shares) // _WIDTH))
    parts = [[s for s in shares[k : k + step] if s is not None] for k in range(0, len(shares), step)]
    return "".join(_block(max(part)) if part else "·" for part in parts)


def _block(share: float) -> str:
    if share < 1.0:
        return _BELOW[min(int(4.0 * share), 3)]
    return _ABOVE[min(int(4.0 * (share - 1.0)), 3)]
