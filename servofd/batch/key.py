"""When is a log done? Its bytes, the aircraft and options it was judged with, and the version that judged."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from servofd.aircraft.schema import UNKNOWN_SERVO, Aircraft, explained_in
from servofd.batch.find import kind_of
from servofd.core.files import distinct_file_names
from servofd.servo.library import find_servo
from servofd.version import __version__

if TYPE_CHECKING:
    from servofd.detection.residual import ThresholdKind

_DIGEST_BYTES = 16
"""Length of the digest that stands for a log."""
_OF_DIGEST = 8
"""Characters of it in the name of a log's page."""


@dataclass(frozen=True, slots=True)
class Job:
    """What to judge logs with, the same for all of them.

    `aircraft`: none: each log's own, as far as the log shows it. `servo`: servo to assume for all surfaces.
    `threshold_deg`: constant alarm level [deg]. `threshold` ({"constant", "interval"}): kind of threshold. `surfaces`:
    which to judge; all if empty. `pages`: whether each log gets its page; it changes no verdict, and is no part of the
    key.
    """

    aircraft: Aircraft | None = None
    servo: str | None = None
    threshold_deg: float | None = None
    threshold: ThresholdKind | None = None
    surfaces: tuple[str, ...] = ()
    pages: bool = False

    @property
    def key(self) -> str:
        """Digest of all of it and of the version of servofd; a servo file counts by its content."""
        servo: Any = self.servo
        if servo not in (None, UNKNOWN_SERVO):
            explained = explained_in(servo)
            if explained is None:
                _, found, levels = find_servo(servo)
                servo = [found.model_dump_json(), str(levels)]
            else:
                servo = [explained.model_dump_json()]
        described = {
            "version": __version__,
            "aircraft": self.aircraft and self.aircraft.model_dump(mode="json"),
            "servo": servo,
            **{name: getattr(self, name) for name in ("threshold_deg", "threshold", "surfaces")},
        }
        return _digest(json.dumps(described, sort_keys=True).encode())


def page_name(path: str, content: str) -> str:
    """File name of the page of a log: its name, and enough of its digest for logs of one name in several folders."""
    (plain,) = distinct_file_names([PurePosixPath(path.replace("\\", "/")).name])
    return f"{plain}-{content[:_OF_DIGEST]}.html"


def content_key(path: str) -> str:
    """Digest of a log's bytes; of a remote one what its store tells of them (an ETag or time stamp), unread."""
    if kind_of(path) == "address":
        from fsspec.core import url_to_fs

        system, name = url_to_fs(path)
        return _digest(str(system.ukey(name)).encode())
    content = hashlib.blake2b(digest_size=_DIGEST_BYTES)
    with Path(path).open("rb") as file:
        hashlib.file_digest(file, lambda: content)
    return content.hexdigest()


def _digest(content: bytes) -> str:
    return hashlib.blake2b(content, digest_size=_DIGEST_BYTES).hexdigest()
