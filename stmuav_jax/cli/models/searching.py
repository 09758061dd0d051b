"""Searches by gradients on the command line: progress, checkpoints, and what is said at the end."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from ...figures.terminal import print_line
from ..output import print_paths

if TYPE_CHECKING:
    from ...math.least_squares import Search

# Loss below which inputs count as holding: departures of a millimetre or a milliradian.
HOLDS = 1e-6


class _Watch:
    """Display of progress on stderr, with a checkpoint after every step."""

    def __init__(self, problem: str, path: Path, steps: int) -> None:
        columns = (TextColumn("{task.description}"), TimeElapsedColumn())
        self.bar = Progress(*columns, console=Console(stderr=True), transient=True)
        self.task = self.bar.add_task("compiling")
        self.problem, self.path, self.steps = problem, path, steps

    def __call__(self, now: "Search") -> None:
        from ...figures.tuning import save_search

        progress_text = (
            f"step {now.steps} of {self.steps}: loss {now.history[-1]:.4g}, best {now.loss:.4g}"
        )
        self.bar.update(self.task, description=progress_text)
        save_search(now, self.problem, self.path)


def run_search(settings: Any, folder: Path, problem: str, start: Any, run: Any) -> Any:
    """Call run(steps=, report=, resume=) with progress, checkpoints and the search to resume."""
    from ...figures.tuning import load_search

    path = folder / "search.npz"
    before = load_search(path, problem, start) if settings.resume else None
    watch = _Watch(problem, path, settings.steps)
    with watch.bar:
        return run(steps=settings.steps, report=watch, resume=before)


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
