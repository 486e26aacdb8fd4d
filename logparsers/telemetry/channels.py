"""The fields of telemetry messages as channels."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any, NamedTuple

from logparsers.channels import MOST_CHANNELS, Series

if TYPE_CHECKING:
    from collections.abc import Collection

    from numpy.typing import NDArray

    from logparsers.telemetry.file import TelemetryFile
    from logparsers.telemetry.messages import Sender

_NO_SERIES = ("PARAM_", "MISSION_", "STATUSTEXT", "FILE_TRANSFER", "LOG_", "REMOTE_LOG", "TERRAIN_DATA")
"""Messages that carry lists, files or words: their numbers are no signal over time."""


class Stream(NamedTuple):
    """Messages that share a clock: one type, from one sender, of one instance."""

    message: str
    source: Sender | None
    instance: object


class TelemetryRecording:
    """Every numeric series of a telemetry log.

    A name is ``MESSAGE.field``; the elements of an array ``MESSAGE.field[0]`` and on. A message that comes in
    several instances has its value in brackets, ``NAMED_VALUE_FLOAT[SRVP1].value``; the number 0 is left out
    (``SERVO_OUTPUT_RAW.servo3_raw`` is port 0, ``SERVO_OUTPUT_RAW[1].servo3_raw`` port 1). ``1/1:`` stands
    before it, system and component, where several sources send that message (named values: that name). Where
    instances are numbered and named (``DEBUG_FLOAT_ARRAY``), the name stands in the channel's origin. Lists, files and
    words (parameters, missions, texts) are no channels.
    """

    def __init__(self, file: TelemetryFile) -> None:
        self._file = file

    def series(self) -> dict[str, Series]:
        """Every series by the name of its channel."""
        found: dict[str, Series] = {}
        for message in self._file.messages:
            if message.startswith(_NO_SERIES):
                continue
            senders: tuple[Sender | None, ...] = self._file.sources(message)
            alone = self._of_one_sender(message)
            for sender in senders if len(senders) > 1 else (None,):
                if len(found) > MOST_CHANNELS:
                    return found
                prefix = f"{sender.system}/{sender.component}:" if sender else ""
                found.update(self._of(message, sender, prefix, alone))
        return found

    def stamps(self, group: Stream) -> tuple[NDArray[Any], None]:
        """Time of each message [s]; those that could not be placed have their arrival time."""
        return self._file.time_s(group.message, source=group.source, instance=group.instance), None

    def values(self, series: Series) -> NDArray[Any]:
        """Numbers of a series in the order of the file."""
        stream: Stream = series.group  # type: ignore[assignment]
        return self._file.column(
            stream.message, series.field, source=stream.source, instance=stream.instance, element=series.element
        )

    def _of_one_sender(self, message: str) -> set[object]:
        """Names that a single sender gives to values, such as those of a monitor beside those of the autopilot."""
        layout = self._file.layout(message)
        if not layout.instance or not layout.fields[layout.instance].is_text:
            return set()
        given = Counter(
            name for sender in self._file.sources(message) for name in self._file.instances(message, sender)
        )
        return {name for name, count in given.items() if count == 1}

    def _of(self, message: str, source: Sender | None, prefix: str, alone: Collection[object]) -> dict[str, Series]:
        """Series of one sender's messages of one type; no prefix for names that nobody else gives."""
        layout = self._file.layout(message)
        clock = layout.clock[0].name if layout.clock else ""
        fields = [f for f in layout.fields.values() if not f.is_text and f.name not in (clock, layout.instance)]
        named = layout.instance != "name" and "name" in layout.fields and layout.fields["name"].is_text
        found: dict[str, Series] = {}
        for instance in self._file.instances(message, source) or (None,):
            if len(found) > MOST_CHANNELS:
                break
            bracket = "" if instance is None or instance == 0 else f"[{instance}]"
            stream = Stream(message, source, instance)
            titles = set(self._file.column(message, "name", source=source, instance=instance)) if named else ()
            title = f"[{next(iter(titles))}]" if len(titles) == 1 and "" not in titles else ""
            for field in fields:
                sender = "" if instance in alone else prefix
                stem, origin = f"{sender}{message}{bracket}.{field.name}", f"{message}{title}.{field.name}"
                if not field.length:
                    found[stem] = Series(stream, field.name, None, field.unit, origin)
                for k in range(field.length):
                    found[f"{stem}[{k}]"] = Series(stream, field.name, k, field.unit, f"{origin}[{k}]")
        return found
