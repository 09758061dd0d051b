"""A process in which JAX is set up in another way, such as without asynchronous dispatch.

XLA reads such options once, when its backend starts; so runs with them and runs without are in
different processes, of which only one computes at a time.
"""

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from multiprocessing import get_context
from typing import Any


@cache
def _other(begin: Callable[[], Any]) -> ProcessPoolExecutor:
    """The process that begins with this function, started when it is needed first."""
    how = {"mp_context": get_context("spawn"), "initializer": begin}
    return ProcessPoolExecutor(max_workers=1, **how)


def in_process(begin: Callable[[], Any], function: Callable[..., Any], *arguments: Any) -> Any:
    """Value of a module's function, computed in the process that begins with a function of a module."""
    return _other(begin).submit(function, *arguments).result()
