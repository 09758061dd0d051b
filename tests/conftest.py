"""Shared set-up of the tests: double precision, shapes checked as the code runs."""

import atexit
import gc
import itertools
import os
import pkgutil
import shutil
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path

# Published problems are those of the benchmarks.
sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))

# tests run side by side; small factorisations lose time to threads that wait for each other
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Most programs here run once, and compiling is nearly all that the tests wait for. Those that the
# package compiles itself have the options of `compiler_options` as everywhere; these are for the
# rest, which would otherwise take three times as long.
QUICK = {"xla_backend_optimization_level": "0", "xla_llvm_disable_expensive_passes": "true"}
# XLA ends a process that gives it a flag which it does not know.
if tuple(map(int, version("jaxlib").split(".")[:2])) < (0, 11):
    QUICK["xla_cpu_use_fusion_emitters"] = "false"
# Workers of pytest-xdist, notebooks and commands inherit them; flags of the user's come last, and win.
flags = [*(f"--{k}={v}" for k, v in QUICK.items()), os.environ.get("XLA_FLAGS", "")]
os.environ["XLA_FLAGS"] = " ".join(flags).strip()

import jax
import numpy as np
import pytest
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
# Programs need not tell which line of Python made which operation.
jax.config.update("jax_traceback_in_locations_limit", 0)

# Compiled code is shared by all tests, workers, notebooks and commands of one run, and lives no
# longer than that, unless STMUAV_TEST_CACHE names a folder that is to be kept.
if "STMUAV_TEST_CACHE" not in os.environ:
    os.environ["STMUAV_TEST_CACHE"] = tempfile.mkdtemp(prefix="stmuav-tests-")
    atexit.register(shutil.rmtree, os.environ["STMUAV_TEST_CACHE"], ignore_errors=True)
CACHE = Path(os.environ["STMUAV_TEST_CACHE"])
os.environ["XDG_CACHE_HOME"] = str(CACHE)
os.environ["JAX_COMPILATION_CACHE_DIR"] = str(CACHE / "stmuav_jax")
os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
jax.config.update("jax_compilation_cache_dir", str(CACHE / "stmuav_jax"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def pytest_configure(config: pytest.Config) -> None:
    """Check annotations as the code runs, before any test imports the package.

    The slow tests run without: checking takes a seventh of their time, and the default tests
    execute the same annotations.
    """
    if str(config.getoption("markexpr")).strip() != "slow":
        install_import_hook(annotated_modules(), "beartype.beartype")
    optimise(0)


def annotated_modules() -> list[str]:
    """All modules but those that make machine code, whose scalar graphs have no shapes."""
    package = Path(__file__).parents[1] / "stmuav_jax"
    folders = {"stmuav_jax": package, "stmuav_jax.math": package / "math"}
    found = [
        f"{at}.{module.name}"
        for at, folder in folders.items()
        for module in pkgutil.iter_modules([str(folder)])
    ]
    return [name for name in found if name not in ("stmuav_jax.math", "stmuav_jax.math.native")]


def optimise(level: int) -> None:
    """Set the level at which the package has its programs compiled."""
    from stmuav_jax.math import compiler
    from stmuav_jax.math.native import llvm

    for options in (compiler._QUICK, compiler._NO_LIBRARY):
        options["xla_backend_optimization_level"] = level
    compiler.compiler_options.cache_clear()
    llvm.settings = llvm.Settings(level)


@pytest.fixture(scope="module")
def optimised():
    """For programs that run for longer than they compile: the level of the package's quick ones."""
    optimise(1)
    yield
    optimise(0)


# Looking for cycles among all that JAX keeps takes a twentieth of the time.
gc.set_threshold(20_000, 20, 100)

# Linux gives a process 65,530 memory maps, and a compiled program takes some twenty for as long as
# it is kept: without this a worker dies after a thousand tests (and the package warns from half of
# them on, which is an error here). Memory is bounded likewise, to a third of the machine's for each
# of two workers.
MAPS, MOST_MAPS = Path("/proc/self/maps"), 28_000
PAGES = Path("/proc/self/statm")
ALL_BYTES = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if MAPS.exists() else 0
most_bytes = [min(8e9, 0.3 * ALL_BYTES)]
ends = itertools.count()


def memory() -> int:
    """Bytes that this process holds."""
    return int(PAGES.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def pytest_runtest_teardown() -> None:
    """Drop compiled programs when there are too many."""
    # Reading the maps takes milliseconds, so not every test does.
    if not MAPS.exists() or next(ends) % 16:
        return
    if memory() > most_bytes[0] or MAPS.read_bytes().count(b"\n") > MOST_MAPS:
        jax.clear_caches()
        gc.collect()
        # not all of it is given back: drop them again when there is as much more
        most_bytes[0] = max(most_bytes[0], memory() + 2e9)


@pytest.fixture(scope="session")
def seven():
    """The seven-body system and random consistent states of it, stacked (6, 7, .)."""
    from helpers import random_seven, seven_bodies

    system, rng = seven_bodies(), np.random.default_rng(11)
    states = [random_seven(system, rng) for _ in range(6)]
    return system, jax.tree.map(lambda *x: jax.numpy.stack(x), *states)


@pytest.fixture(scope="session")
def short_run():
    """One short run of the UAV, shared by the tests of files and figures."""
    from stmuav_jax import make_scene, simulate

    return simulate(make_scene("uav_tracker", 2), t1=0.05, save_every=0.01)


@pytest.fixture
def machine_code():
    """Turns machine code on or off for the time of a test."""
    from stmuav_jax.math import use_native_code
    from stmuav_jax.math.native import program

    before = program._Switch.on
    yield use_native_code
    use_native_code(before)
