"""Searches by gradients on the command line: progress, checkpoints, and the final message."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from ...figures.terminal import print_line
from ..output import print_paths, show_progress

if TYPE_CHECKING:
    from ...math.least_squares import Search

# Loss below which inputs count as holding: departures of a millimetre or a milliradian.
HOLDS = 1e-6


def run_search(settings: Any, folder: Path, problem: str, start: Any, run: Any) -> Any:
    """Call run(steps=, report=, resume=) with progress, checkpoints and the search to resume."""
    from ...figures.tuning import load_search, save_search

    path, steps = folder / "search.npz", settings.steps
    before = load_search(path, problem, start) if settings.resume else None
    with show_progress("compiling") as report:

        def report_step(now: "Search") -> None:
            losses = f"loss {now.history[-1]:.4g}, best {now.loss:.4g}"
            report(now.steps / steps, f"step {now.steps} of {steps}: {losses}")
            save_search(now, problem, path)

        return run(steps=steps, report=report_step, resume=before)


def has_converged(search: "Search") -> bool:
    """True if the search ended because it converged."""
    from ...math.least_squares import SearchReason

    return search.reason is SearchReason.CONVERGED


def loss_figures(
    search: "Search", folder: Path, kind: str, more: dict[str, Any] | None = None
) -> list[Path]:
    """Write the figure of the losses, and others by name, in a format; none for "none"."""
    from ...figures.plot import save_figures
    from ...figures.tuning import loss_history

    if kind == "none":
        return []
    return save_figures({"loss": loss_history(search.history)} | (more or {}), folder, kind)


def report_search(
    search: "Search",
    table: Table,
    folder: Path,
    figures: list[Path],
    is_successful: bool,
    else_words: str,
) -> int:
    """Print results and files of a search, or that it has not converged; return the exit code."""
    from ...math.least_squares import SearchReason

    out = Console()
    out.print(table)
    print_line(out, search.describe())
    print_paths(out, [folder / "search.npz", *figures])
    if search.reason is SearchReason.INTERRUPTED:
        return 130
    if not is_successful:
        print_line(Console(stderr=True), f"stmuav: {else_words}")
    return 0 if is_successful else 1
