"""The key that frames of a link are signed with."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from logparsers.codec import Signature


def signature_of(name: str | None) -> Signature | None:
    """Signature with the key in a file, from now on; none without a file.

    Examples
    --------
    >>> print(signature_of(None))
    None
    """
    from logparsers.codec import Signature, signing_key
    from servofd.core.errors import ConfigError

    if name is None:
        return None
    try:
        content = Path(name).read_bytes()
    except OSError as error:
        raise ConfigError(f"--signing-key {name}: cannot read it ({error.strerror or error})") from None
    if not content.strip():
        raise ConfigError(f"--signing-key {name}: holds no key; give 32 bytes, 64 hex digits, or a passphrase")
    return Signature(signing_key(content), time.time())
