"""Which effects there are: those of the package, and those that a user adds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache

import servofd.servo.effects as _modules
from servofd.core.errors import ConfigError
from servofd.servo.effect import Effect


@lru_cache(maxsize=1)
def _built_in() -> tuple[type[Effect], ...]:
    """Effects of the package, in the order of its modules: within a slot it is the order in which they act."""
    return tuple(
        each
        for module in vars(_modules).values()
        if getattr(module, "__name__", "").startswith(f"{_modules.__name__}.")
        for each in vars(module).values()
        if isinstance(each, type) and issubclass(each, Effect) and each.__module__ == module.__name__
    )


_added: tuple[type[Effect], ...] = ()


@lru_cache(maxsize=1)
def everything() -> tuple[type[Effect], ...]:
    """All effects and numbers of the servo's own, in the order in which they act."""
    return (*_built_in(), *_added)


def _know(added: tuple[type[Effect], ...]) -> None:
    global _added  # noqa: PLW0603 - one set of effects is known at a time
    _added = added
    everything.cache_clear()


def catalogue() -> tuple[type[Effect], ...]:
    """Effects that may be missing from a model, simple before flexible.

    Where data cannot tell two effects apart, the earlier one is named.

    Examples
    --------
    >>> [effect.name for effect in catalogue()][:3]
    ['bias', 'gain', 'delay']
    """
    return tuple(sorted((e for e in everything() if e.searched), key=lambda effect: effect.rank))


def is_built_in(effect: type[Effect]) -> bool:
    """Whether an effect stands in the package, and not in a file of the user's own."""
    return effect in _built_in()


def check_name(effect: type[Effect]) -> None:
    """Refuse (`ConfigError`) an effect whose name and form the package has."""
    if effect.key() in {known.key() for known in _built_in()}:
        raise ConfigError(f"effect {effect.key()}: the catalogue has one of this name")


def include(effect: type[Effect]) -> None:
    """Know an effect as well, as if it stood in the package; one of the same name and form from before goes.

    Raises `ConfigError` if the package has an effect of this name and form.
    """
    check_name(effect)
    fields_of((*_built_in(), effect))
    _know((*(each for each in _added if each.key() != effect.key()), effect))


@contextmanager
def including(effect: type[Effect]) -> Iterator[None]:
    """Know an effect for a while."""
    before = _added
    include(effect)
    try:
        yield
    finally:
        _know(before)


@lru_cache(maxsize=8)
def fields_of(effects: tuple[type[Effect], ...]) -> Mapping[str, float]:
    """Sizes that effects have, each with the one at which nothing is bent."""
    off: dict[str, float] = {}
    for effect in effects:
        for p in effect.parameters:
            for field in p.fields:
                if off.setdefault(field, p.off) != p.off:
                    raise ConfigError(f"effect {effect.name}: {field} is off at {p.off:g}, elsewhere at {off[field]:g}")
    return off
