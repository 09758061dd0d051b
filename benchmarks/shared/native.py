"""A process in which XLA compiles loops into native functions.

XLA reads the option once, when its backend starts; so runs with it and runs without are in two
processes, of which only one computes at a time.
"""

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from multiprocessing import get_context
from typing import Any

import stmuav_jax as stm


@cache
def _other() -> ProcessPoolExecutor:
    """The process with native loops, started when it is needed first."""
    how = {"mp_context": get_context("spawn"), "initializer": stm.algebra.use_native_loops}
    return ProcessPoolExecutor(max_workers=1, **how)


def with_native_loops(function: Callable[..., Any], *arguments: Any) -> Any:
    """Value of a module's function, computed in the process with native loops."""
    return _other().submit(function, *arguments).result()
