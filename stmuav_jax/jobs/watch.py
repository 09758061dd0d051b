"""Progress of a study on a terminal."""

from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

from .progress import Standing


class Watch:
    """A bar on stderr with rate and remaining time, as `progress` of a run; notes stay above it.

    with Watch() as watch:
        run_study(work, path, total, progress=watch)
    """

    def __init__(self, words: str = "samples") -> None:
        columns = (
            TextColumn("{task.description}", markup=False), BarColumn(), TaskProgressColumn(),
            TextColumn("{task.fields[standing]}", markup=False), TimeElapsedColumn(),
        )  # fmt: skip
        self.bar = Progress(*columns, console=Console(stderr=True), transient=True)
        self.task = self.bar.add_task(words, total=None, standing="starting")

    def __enter__(self) -> "Watch":
        self.bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.bar.stop()

    def __call__(self, now: Standing) -> None:
        if now.note:
            self.bar.console.print(now.note, highlight=False, markup=False, emoji=False)
        self.bar.update(self.task, total=now.total, completed=now.done, standing=now.words())
