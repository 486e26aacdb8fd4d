"""An existing Dask cluster, through its concurrent.futures interface; the only file that imports distributed."""

from __future__ import annotations

import re
from concurrent.futures import CancelledError, as_completed
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

from servofd.core.errors import ConfigError, ServofdError
from servofd.version import __version__

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_PATIENCE_S = 10.0
_ADDRESS = re.compile(r"\w+://\S+")
_INSTALL = "pip install 'servofd[cluster]'"


class LostCluster(ServofdError):  # noqa: N818 - reads better without "Error"
    """The scheduler is gone in the middle of the work."""


def run_on_cluster(
    address: str, task: Callable[[_Item], _Result], items: Sequence[_Item]
) -> Iterator[tuple[_Item, _Result | Exception]]:
    """Do a task for each item on a cluster; results come as they are ready.

    Which worker does what, and what becomes of the work of one that dies, is the scheduler's business: it hands the
    work to others, and gives up an item that several workers died of.

    Parameters
    ----------
    address : str
        Of the scheduler, such as ``"tcp://scheduler:8786"``.
    task : callable
        A function of a module that the workers have, too, or a partial of one.
    """
    with _client(address) as client:
        executor = client.get_executor(pure=False)
        futures = {executor.submit(task, item): item for item in items}
        for future in as_completed(futures):
            item = futures.pop(future)
            try:
                result: _Result | Exception = future.result()
            except CancelledError:
                raise LostCluster(f"{address}: the scheduler went away; start again to go on") from None
            except Exception as error:
                result = error
            yield item, result


@contextmanager
def _client(address: str) -> Iterator[Any]:
    """Connection to a cluster that can do the work."""
    if not _ADDRESS.fullmatch(address):
        raise ConfigError(f"{address}: is no address of a Dask scheduler; give it as tcp://HOST:8786")
    try:
        from distributed import Client
    except ImportError:
        raise ConfigError(f"{address}: a cluster needs Dask distributed: {_INSTALL}") from None
    try:
        client = Client(address, timeout=_PATIENCE_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise ConfigError(
            f"{address}: no Dask scheduler answers within {_PATIENCE_S:g} s ({type(error).__name__}); "
            "give its address as tcp://HOST:8786"
        ) from None
    try:
        _check_workers(client, address)
        yield client
    finally:
        client.close(timeout=_PATIENCE_S)


def _check_workers(client: Any, address: str) -> None:  # noqa: ANN401 - distributed is imported late
    """Refuse a cluster that could only fail, once and in a sentence."""
    try:
        client.wait_for_workers(1, timeout=_PATIENCE_S)
    except TimeoutError:
        raise ConfigError(f"{address}: the scheduler has no workers; start some with dask worker {address}") from None
    try:
        versions = set(client.run(_version).values())
    except Exception as error:
        raise ConfigError(f"{address}: the workers cannot run servofd: {error}; {_INSTALL} on each of them") from None
    if versions != {__version__}:
        raise ConfigError(
            f"{address}: the workers have servofd {', '.join(sorted(versions))}, and this machine {__version__}; "
            "install the same on all"
        )


def _version() -> str:
    return __version__
