"""DataFlash columns as channels: ``"RCOU.C1"``, ``"CSRV[0].Pos"``, ``"NVF[UMPOS_1].Value"``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from logparsers.channels import MOST_CHANNELS, Series
from logparsers.dataflash.formats import DICTIONARY

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from logparsers.dataflash.file import DataFlashFile

    Group = tuple[str, Any]


class DataFlashRecording:
    r"""The numeric columns of a log that carry a time stamp."""

    def __init__(self, file: DataFlashFile) -> None:
        self._file = file

    def series(self) -> dict[str, Series]:
        """Every series by the name of its channel."""
        found: dict[str, Series] = {}
        for message in self._timed():
            layout = self._file.formats[message]
            clock = layout.clock and layout.clock[0]
            fields = [f for f in layout.fields.values() if f.is_number and f.name not in (clock, layout.instance)]
            instances = self._file.instances(message) if layout.instance is not None else (None,)
            for instance in instances:
                if len(found) > MOST_CHANNELS:
                    return found
                which = "" if instance is None else f"[{instance}]"
                for field in fields:
                    origin = f"{message}.{field.name}"
                    series = Series((message, instance), field.name, None, field.unit, origin)
                    found[f"{message}{which}.{field.name}"] = series
        return found

    def stamps(self, group: Group) -> tuple[NDArray[np.float64], NDArray[np.bool_] | None]:
        """Time of each row [s], and whether it agrees with the rows around it (None: all do)."""
        suspect = self._file.suspect(*group)
        return self._file.times_s(*group), ~suspect if suspect.any() else None

    def values(self, series: Series) -> NDArray[Any]:
        """Numbers of a series in the order of the file."""
        group: Group = series.group  # type: ignore[assignment]
        return self._file.column(group[0], series.field, group[1])

    def _timed(self) -> list[str]:
        known = self._file.formats
        return [name for name in self._file.names if name not in DICTIONARY and known[name].clock is not None]
