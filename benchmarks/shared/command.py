"""Command line of the benchmarks, which all have the same options and write the same way."""

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
from shared.record import RESULTS, ROOT, write_record

# Every benchmark computes in double precision; this comes before the package makes any array.
jax.config.update("jax_enable_x64", True)

FIGURES = ROOT / "docs" / "figures" / "benchmarks"


def parser(about: str | None, **switches: str) -> argparse.ArgumentParser:
    """A parser with the option `--results` that all scripts share, and switches by name."""
    made = argparse.ArgumentParser(
        description=about, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    made.add_argument("--results", type=Path, default=RESULTS)
    for name, help_text in switches.items():
        made.add_argument(f"--{name}", action="store_true", help=help_text)
    return made


def benchmark(
    name: str,
    about: str | None,
    measure: Callable[[Any], Iterator[dict[str, Any]]],
    sizes: tuple[Any, Any],
    show: Callable[[Path, Path], Any] | None = None,
) -> None:
    """The main function of a benchmark.

    Args:
        measure: yields the record, and before it, if it takes long, what there is so far.
        sizes: the argument of `measure`, for the full run and with `--quick`.
        show: draws figures from the record at a path into a folder (`--figures`).
    """
    made = parser(about, quick="the smallest size, for a smoke test")
    if show:
        made.add_argument("--figures", type=Path, default=FIGURES)
    options = made.parse_args()
    path = options.results / f"{name}.json"
    for content in measure(sizes[options.quick]):
        path = write_record(name, content, options.results)
    print(path)
    if show:
        print(show(path, options.figures))
