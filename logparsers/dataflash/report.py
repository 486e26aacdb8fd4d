"""What was found wrong with a DataFlash log, in the words every reader uses."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from logparsers.dataflash.scan import BACK_US
from logparsers.records import Damage

if TYPE_CHECKING:
    from logparsers.dataflash.store import Step, Store, Stretch

__all__ = ["describe"]

PAGE: Final = 528  # boards that log to flash pages leave up to this many bytes unused at the end
WORDS: Final = {
    "zeros": "zeros",
    "erased": "erased memory (FF)",
    "garbage": "no record",
    "cut_record": "a record that is cut short",
    "unknown_type": "a message whose definition is missing",
    "truncated": "the file ends inside a record",
    "bad_line": "not a complete line of a known message",
}


def describe(store: Store) -> tuple[Damage, ...]:
    """List everything that is wrong with a log.

    Parameters
    ----------
    store : Store
        Its index.

    Returns
    -------
    tuple of Damage
        Kind ``"corrupt"`` or ``"truncated"`` (`count`: bytes), ``"gap"``, ``"reboot"``, and
        ``"bad_format"``. Unused space at the end of the last flash page is not damage.
    """
    damage = [_stretch(s) for s in store.stretches if not _is_padding(s, store.size)]
    number, size = store.more_stretches
    if number:
        damage.append(Damage("corrupt", f"{number} more damaged stretches, {size} bytes", size))
    damage += [_step(s) for s in store.steps]
    damage += [Damage("bad_format", note) for note in store.notes]
    return tuple(damage)


def _is_padding(stretch: Stretch, size: int) -> bool:
    at_end = stretch.offset + stretch.length == size
    return at_end and stretch.length <= PAGE and stretch.kind in ("zeros", "erased")


def _stretch(stretch: Stretch) -> Damage:
    kind = "truncated" if stretch.kind == "truncated" else "corrupt"
    note = f"{stretch.length} bytes at byte {stretch.offset}: {WORDS[stretch.kind]}"
    return Damage(kind, note, stretch.length, _seconds(stretch.before_us), _seconds(stretch.after_us))


def _step(step: Step) -> Damage:
    before, after = step.before_us / 1.0e6, step.after_us / 1.0e6
    if step.after_us < step.before_us - BACK_US:
        note = f"the clock went back from {before:.3f} s to {after:.3f} s: reboot, or two logs in one file"
        return Damage("reboot", note, 1, before, after)
    return Damage("gap", f"nothing logged for {after - before:.3f} s", 1, before, after)


def _seconds(time_us: int | None) -> float | None:
    return None if time_us is None else time_us / 1.0e6
