"""Channels side by side in one table."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pandas as pd

    from logparsers.records import Channel

__all__ = ["MOST_CELLS", "joined"]

MOST_CELLS = 100_000_000
"""A larger table (0.8 GB) is a mistake: hundreds of channels that share no time stamps."""


def joined(channels: Sequence[Channel]) -> pd.DataFrame:
    """Join channels on their time stamps; see `FlightLog.to_pandas`.

    Parameters
    ----------
    channels : sequence of Channel
        At least one.

    Returns
    -------
    pandas.DataFrame
        A row for every time stamp of any channel, NaN where a channel has no sample.

    Examples
    --------
    >>> from logparsers.records import Channel
    >>> slow = Channel("slow", [0.0, 1.0], [5.0, 6.0], "deg", "")
    >>> fast = Channel("fast", [0.0, 0.5, 1.0], [1.0, 2.0, 3.0], "", "")
    >>> joined([slow, fast])["slow"].tolist()
    [5.0, nan, 6.0]
    """
    import pandas as pd

    clocks = {id(channel.time_s): channel.time_s for channel in channels}
    time_s = np.unique(np.concatenate(list(clocks.values())))
    if time_s.size * len(channels) > MOST_CELLS:
        raise ValueError(
            f"{len(channels)} channels on {time_s.size} time stamps make a table of {time_s.size * len(channels):.1e} "
            f"cells; name fewer channels, for example to_pandas({channels[0].name!r})"
        )
    rows = {key: np.searchsorted(time_s, stamps) for key, stamps in clocks.items()}
    columns = {}
    for channel in channels:
        column = np.full(time_s.size, np.nan)
        column[rows[id(channel.time_s)]] = channel.values
        columns[channel.name] = column
    table = pd.DataFrame(columns, index=pd.Index(time_s, name="time_s"), copy=False)
    table.attrs["units"] = {channel.name: channel.unit for channel in channels}
    return table
