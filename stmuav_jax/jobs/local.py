"""Execution of a study in this process."""

import os

from ..files.layout import computing_versions
from ..montecarlo.work import AbstractWork
from .compute import MEMORY, Pieces, chunk_size
from .keep import Keeper, New, Report, begin
from .progress import Outcome
from .stop import stoppable


def run_study(
    work: AbstractWork,
    path: str | os.PathLike[str],
    total: int,
    *,
    chunk: int | None = None,
    resume: bool = False,
    progress: Report | None = None,
    memory: int = MEMORY,
) -> Outcome:
    """Compute the missing samples of a study, chunk by chunk.

    Each chunk is written while the next is computed, and is stored whole or not at all: a run that
    is killed loses at most the two chunks in progress, and a run that resumes it ends with the same
    files. Ctrl-C, or SIGTERM, ends the run after the chunk that is being written; a second one does
    not wait for the progress function.

    Args:
        work: work of the study.
        path: folder of the store.
        total: number of samples; more than the store has extend it.
        chunk: number of samples computed and written together, fixed when a store is created;
            default some seconds' worth, measured, whose results fit in `memory`.
        resume: continue the store if there is one.
        progress: function called with a `Standing` at the start, after each chunk and with each
            note.
        memory: largest size of a chunk's results in bytes.

    Returns:
        outcome of the run; `interrupted` if Ctrl-C has ended it.

    Raises:
        FileError: the store exists and `resume` is not set, or it is damaged, of another study or
            of other versions; or the disk is full (written chunks are kept).
        SettingError: impossible settings, or columns other than those that the work declares.
        SimulationError: not even a single sample fits in memory.
    """
    pieces = Pieces(work)

    def new() -> New:
        if chunk is not None:
            return New(chunk, computing_versions())
        size = chunk_size(work, total, pieces.seconds(total), memory)
        return New(size, computing_versions())

    interrupted = False
    with (
        stoppable() as stop,
        begin(work, path, total, chunk=chunk, resume=resume, new=new) as store,
        Keeper(store, progress) as keeper,
    ):
        try:
            for number in store.waiting():
                keeper.keep(number, pieces(*store.todo(number)))
            keeper.settle()
        except KeyboardInterrupt:
            stop.heard()
            interrupted = True
            keeper.settle()
        return keeper.outcome(interrupted=interrupted)
