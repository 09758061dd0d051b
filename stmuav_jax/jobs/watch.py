"""Progress of a study on a terminal."""

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

from .progress import StudyProgress


class Watch:
    """Progress bar on stderr with rate and remaining time, for `progress` of a run.

    Notes are printed above the bar. Example:

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

    def __exit__(self, *_: object) -> None:
        self.bar.stop()

    def __call__(self, now: StudyProgress) -> None:
        if now.note:
            self.bar.console.print(now.note, highlight=False, markup=False, emoji=False)
        self.bar.update(self.task, total=now.total, completed=now.done, standing=now.words())
