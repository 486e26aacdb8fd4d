"""What can go wrong with a log as a whole. Local damage never raises: it becomes `Damage`."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class LogError(Exception):
    """A log is of no use as a whole; the message says what, where, and what would have worked."""


class MissingLog(LogError):  # noqa: N818 - reads better without "Error" where it is raised
    """There is no such file, or it cannot be opened."""


class UnknownFormat(LogError):  # noqa: N818
    """No reader recognises the first bytes of the file."""


class EmptyLog(LogError):  # noqa: N818
    """The file holds no samples."""


class UnreadableLog(LogError):  # noqa: N818
    """The format is known, but the content contradicts it."""


class TruncatedLog(LogError):  # noqa: N818
    """The file stops inside a channel, so that the channel is lost for the whole flight."""


class ClockError(LogError):
    """The time stamps cannot be put in order."""


class MissingChannel(LogError):  # noqa: N818
    """A channel that was asked for is not in the log."""


class LinkError(LogError):
    """A live stream cannot be opened, or not any more."""


class SeveralRuns(LogError):  # noqa: N818
    """One log was asked for, but the file holds several experiments."""


@contextmanager
def decoding(path: Path, what: str) -> Iterator[None]:
    """Run a decoder made by others: whatever it throws at damaged bytes becomes one line; its warnings are muted."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except LogError:
        raise
    except Exception as error:  # decoders throw anything from struct.error to RecursionError
        raise UnreadableLog(f"{path}: not a sound {what}: {reason_of(error)}; copy or export it again") from error


def reason_of(error: BaseException) -> str:
    """What went wrong, in one line."""
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return text.strip().splitlines()[0][:200]
