"""Pinocchio in C++ with Boost's Runge-Kutta-Fehlberg 7(8); compiled on first use and kept.

Only headers are needed: Pinocchio's, Boost's and Eigen's, as the wheels `pin` and
`cmeel-eigen` (or the system) bring them. The compiler takes about two minutes.
"""

import functools
import hashlib
import importlib.util
import os
import shutil
import subprocess
import tempfile
import time
from importlib import metadata
from pathlib import Path

import numpy as np
from problems.plain import start, starts, why_not
from problems.tree import span

from peers.adapter import Outcome, Peer, Prepared, Setting, tolerances
from peers.pinocchio_model import linked, model_text, start_vectors, starts_text
from stmuav_jax import Scene, State

SOURCE = Path(__file__).with_suffix(".cpp")
# The limits are those that Pinocchio's own build files ask for.
FLAGS = (
    "-std=c++17", "-O3", "-march=native", "-DNDEBUG", "-w", "-DBOOST_MPL_LIMIT_LIST_SIZE=30",
    "-DBOOST_MPL_LIMIT_VECTOR_SIZE=30", "-DBOOST_MPL_CFG_NO_PREPROCESSED_HEADERS",
    "-DBOOST_FUSION_INVOKE_MAX_ARITY=12",
)  # fmt: skip
Words = dict[str, list[list[float]]]


def include_folders() -> dict[str, Path | None]:
    """Where the headers of Pinocchio, Boost and Eigen are; None for those not found."""
    found = importlib.util.find_spec("cmeel")
    roots = [Path("/usr/include"), Path("/usr/local/include")]
    if found and found.origin:
        roots.insert(0, Path(found.origin).parents[1] / "cmeel.prefix" / "include")
    folders = [*roots, *(root / "eigen3" for root in roots)]
    first = lambda file: next((folder for folder in folders if (folder / file).exists()), None)
    return {
        "Pinocchio": first("pinocchio/algorithm/crba.hpp"), "Eigen": first("Eigen/Core"),
        "Boost odeint": first("boost/numeric/odeint.hpp"),
    }  # fmt: skip


def compiler() -> str | None:
    """Path of the C++ compiler."""
    return shutil.which(os.environ.get("CXX", "g++"))


@functools.cache
def program_path() -> Path:
    """Where the compiled program of this source, compiler, headers and processor is kept."""
    version = subprocess.run([str(compiler()), "--version"], capture_output=True, check=True).stdout
    # -march=native: the program of one processor may not run on another
    cpu = Path("/proc/cpuinfo")
    lines = cpu.read_text().splitlines() if cpu.exists() else []
    flags = [line for line in lines if line.startswith("flags")]
    sources = b"".join(SOURCE.with_suffix(x).read_bytes() for x in (".hpp", ".cpp"))
    key = hashlib.sha256(sources + version)
    for text in (*FLAGS, *flags[:1], metadata.version("pin")):
        key.update(text.encode())
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    return cache / "stmuav-benchmarks" / f"pinocchio_cpp_{key.hexdigest()[:16]}"


def compile_program() -> tuple[Path, float]:
    """The program, compiled if it is not yet there, and the seconds that this took.

    Raises:
        RuntimeError: the compiler's message.
    """
    path = program_path()
    if path.exists():
        return path, 0.0
    path.parent.mkdir(parents=True, exist_ok=True)
    includes = [x for folder in set(include_folders().values()) for x in ("-isystem", str(folder))]
    clock = time.perf_counter()
    # under another name first, so that an interrupted build is not taken for the program
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        built = Path(folder) / "program"
        command = [str(compiler()), *FLAGS, *includes, str(SOURCE), "-o", str(built)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"Compiling {SOURCE.name} failed:\n{done.stderr[-2000:]}")
        built.rename(path)
    return path, time.perf_counter() - clock


class Texts:
    """A scene's model and starts, as the program reads them from two files."""

    def __init__(self, scene: Scene, states: list[State] | None = None) -> None:
        tree, links = linked(scene)
        first = [start(scene)] if states is None else states
        self.model, self.bodies = model_text(links), len(links.bodies)
        self.starts = starts_text([(scene.t0, *start_vectors(tree, state)) for state in first])

    def call(self, program: Path, mode: str, *arguments: float) -> Words:
        """Run the program in a mode; its lines by their first word.

        Raises:
            RuntimeError: what it wrote when it failed.
        """
        with tempfile.TemporaryDirectory() as folder:
            names = Path(folder) / "model", Path(folder) / "starts"
            names[0].write_text(self.model)
            names[1].write_text(self.starts)
            command = [str(x) for x in (program, mode, *names)]
            command += [f"{x:.17g}" for x in arguments]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"{program.name} {mode} failed: {done.stderr.strip()}")
        words: Words = {}
        for line in done.stdout.splitlines():
            name, *numbers = line.split()
            words.setdefault(name, []).append([float(x) for x in numbers])
        return words


class PinocchioCpp(Peer):
    """Pinocchio as a C++ user would write it; the program times itself."""

    name = "Pinocchio (C++), Boost rkf78"
    packages = (("pinocchio", "pin"),)
    how = (
        "CRBA, RNEA and a sparse Cholesky factor of the mass matrix, Cholesky of the cut joints' "
        "rows; g++ -O3 -march=native, header templates; controlled steps with absolute and relative "
        "tolerance equal."
    )
    caveats = ("Compiled once by the C++ compiler for all scenes.",)
    repeats = 5

    def missing(self) -> str:
        if reason := super().missing():
            return reason
        if compiler() is None:
            return "There is no C++ compiler (g++, or what CXX names)."
        lacking = [name for name, folder in include_folders().items() if folder is None]
        return f"No headers of {', '.join(lacking)} were found." if lacking else ""

    def unsupported(self, scene: Scene) -> str:
        return why_not(scene, span)

    def settings(self, scene: Scene | None = None) -> list[Setting]:
        return tolerances("rkf78")

    def prepare(self, scene: Scene, times: np.ndarray, setting: Setting) -> Prepared:
        program, seconds = compile_program()
        texts, tolerance = Texts(scene), setting.tolerance or 1e-6

        def run() -> Outcome:
            words = texts.call(program, "run", tolerance, self.repeats, *times)
            positions = np.full((len(times), texts.bodies, 3), np.nan)
            for k, row in enumerate(words.get("positions", [])):
                positions[k] = np.reshape(row, (-1, 3))
            said = "The step became too small, or the state not finite."
            counts = {k: int(words[k][0][0]) for k in ("evaluations", "accepted", "rejected")}
            return Outcome(
                positions, **counts, residual=words["residual"][0][0],
                seconds=[row[0] for row in words["seconds"]],
                failure=said if words["failed"][0][0] else "",
            )  # fmt: skip

        return Prepared(run, seconds)

    def throughput(
        self, scene: Scene, states: State, t1: float, setting: Setting
    ) -> tuple[float, np.ndarray]:
        program, _ = compile_program()
        texts, tolerance = Texts(scene, starts(states)), setting.tolerance or 1e-6
        words = texts.call(program, "many", tolerance, self.repeats, t1)
        ends = np.reshape(words["positions"], (-1, texts.bodies, 3))
        return len(ends) / float(np.median(words["seconds"])), ends
