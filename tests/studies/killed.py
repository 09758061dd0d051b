"""Runs a study in processes that are killed (SIGKILL) at random moments, and then to its end.

    python killed.py STORE TOTAL CHUNK KILLS SEED

Prints how many samples were stored when each was killed. Processes are forked from this one, in
which everything is imported and no thread runs, so that a life takes no longer than its work.
"""

import os
import random
import signal
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from studies.toy import Toy

from stmuav_jax.io.netcdf import FileError
from stmuav_jax.studies import open_store

WORK = Toy(seed=7, pause=0.01, more=4)
# Chunks that a process may store before it is killed.
LONGEST = 12


def life(path: str, total: int, chunk: int, chunks: int | None, seconds: float) -> bool:
    """One process that may store some chunks, and live some seconds more; whether it was killed."""
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        tell = lambda now: os.write(writer, b".")
        WORK.run(path, total, chunk=chunk, resume=True, progress=tell)
        os._exit(0)
    os.close(writer)
    seen = 0
    while (chunks is None or seen < chunks) and os.read(reader, 1):
        seen += 1
    time.sleep(seconds)
    os.close(reader)
    if chunks is not None:
        os.kill(child, signal.SIGKILL)
    return os.WIFSIGNALED(os.waitpid(child, 0)[1])


def stored(path: str) -> int:
    """Samples whose chunk is complete."""
    try:
        return open_store(path).finished
    except FileError:
        return 0


def main() -> None:
    path, (total, chunk, kills, seed) = sys.argv[1], map(int, sys.argv[2:])
    rng = random.Random(seed)
    for _ in range(kills):
        chunks = rng.randrange(LONGEST + 1)
        # none: somewhere on the way to the first
        if life(path, total, chunk, chunks, rng.uniform(0, 0.05 if chunks else 0.5)):
            print(stored(path))
    assert not life(path, total, chunk, None, 0.0)


if __name__ == "__main__":
    main()
