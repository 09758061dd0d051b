"""What a program that runs for days relies on: same bits, threads, flat memory, no global state."""

import hashlib
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import four_bar, four_bar_state, pendulum, swung

import stmuav_jax as stm

MAPS, PAGES = Path("/proc/self/maps"), Path("/proc/self/statm")
TIMES = np.linspace(0.0, 0.5, 6)


def flown(mass: float) -> stm.Run:
    """A pendulum of a given mass, damped so that the mass matters."""
    brake = stm.JointDamping("hinge", turning=0.3)
    system = pendulum(mass=mass, forces=(brake,))
    return stm.simulate(system, swung(system, 1.0), ts=TIMES)


def bits(run: stm.Run) -> str:
    """Digest of all saved states."""
    digest = hashlib.sha256()
    for array in jax.tree.leaves(run.states):
        digest.update(np.asarray(array).tobytes())
    return digest.hexdigest()


@pytest.mark.slow
def test_the_same_inputs_give_the_same_bits():
    first = bits(flown(1.7))
    flown(2.5)
    assert bits(flown(1.7)) == first


@pytest.mark.slow
def test_other_numbers_trace_and_compile_nothing():
    """Nothing is traced again either, which would take longer than a short run."""
    flown(1.7)
    flown(1.9)
    traced: list[str] = []

    def note(event: str, duration_secs: float, **_: object) -> None:
        del duration_secs
        traced.extend([event] if event.startswith("/jax/core/compile/") else [])

    jax.monitoring.register_event_duration_secs_listener(note)
    try:
        jax.jit(lambda x: x + 1.7)(1.0)
        assert traced  # the events have these names
        traced.clear()
        flown(2.1)
    finally:
        jax.monitoring.unregister_event_duration_listener(note)
    assert traced == []


AGAIN = """
import jax
jax.config.update("jax_enable_x64", True)
from test_service import bits, flown
print(bits(flown(1.7)))
"""


@pytest.mark.slow
def test_another_process_gives_the_same_bits():
    """Two fresh processes with the same options; XLA orders sums at compile time only."""
    here = Path(__file__).parent
    path = os.pathsep.join(str(p) for p in (here, here.parent, here.parents[1]))
    found = [
        subprocess.run(
            [sys.executable, "-c", AGAIN], check=True, text=True,
            capture_output=True, timeout=300, env=os.environ | {"PYTHONPATH": path},
        ).stdout.split()[-1]
        for _ in range(2)
    ]  # fmt: skip
    assert found[0] == found[1]


@pytest.mark.slow
def test_threads_do_not_disturb_each_other():
    masses = [0.5 + 0.1 * k for k in range(12)]
    alone = [bits(flown(mass)) for mass in masses]
    with ThreadPoolExecutor(4) as pool:
        together = [bits(run) for run in pool.map(flown, masses)]
    assert together == alone


def chained(count: int) -> stm.Run:
    """A chain of so many links, each number of them a program of its own."""
    bodies = [
        stm.Body(f"link{k}", 1.0, (0.02, 0.02, 0.01), position=(0.0, 0.0, -0.2 - 0.4 * k))
        for k in range(count)
    ]
    names = ["ground", *(body.name for body in bodies)]
    hinges = [
        stm.revolute(f"hinge{k}", *pair, point=(0.0, 0.0, -0.4 * k), axis=(0.0, 1.0, 0.0))
        for k, pair in enumerate(pairwise(names))
    ]
    system = stm.System(bodies, hinges, [stm.Gravity()])
    start = stm.state_from_joints(system, {f"hinge{k}": 0.5 - 0.1 * k for k in range(count)})
    return stm.simulate(system, start, ts=TIMES, analysis=False)


@pytest.mark.slow
def test_threads_compile_different_programs_at_once():
    """Three systems of different structure, none compiled before; then one by one, compiled again."""
    jax.clear_caches()
    with ThreadPoolExecutor(4) as pool:
        together = [bits(run) for run in pool.map(chained, range(1, 4))]
    jax.clear_caches()
    assert [bits(chained(count)) for count in range(1, 4)] == together


@pytest.mark.skipif(not hasattr(os, "fork"), reason="This system cannot fork.")
def test_a_fork_after_the_first_computation_is_refused():
    """JAX's threads are not copied: without the refusal the fork would wait forever."""
    code = (
        "import os, warnings; warnings.simplefilter('ignore'); import jax.numpy as jnp\n"
        "from stmuav_jax.math.compiler import kept_jit\n"
        "double = kept_jit(lambda x: x + x)\n"
        "double(jnp.ones(2))\n"
        "if os.fork():\n    os.wait()\n"
        "else:\n"
        "    try: double(jnp.ones(2))\n"
        "    except RuntimeError as error: print(error, flush=True)\n"
        "    os._exit(0)"
    )
    done = subprocess.run([sys.executable, "-c", code], text=True, capture_output=True, timeout=60)
    assert "multiprocessing.get_context('spawn')" in done.stdout


@pytest.mark.slow
def test_importing_leaves_the_settings_of_jax_alone():
    code = (
        "import jax; before = dict(jax.config.values); import stmuav_jax as stm; "
        "stm.Body, stm.simulate, stm.estimation, stm.studies; "
        "after = dict(jax.config.values); "
        "print([k for k in before if before[k] != after.get(k)])"
    )
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], check=True, text=True, capture_output=True
    )
    assert done.stdout.strip() == "[]"
    assert done.stderr == ""


@pytest.mark.slow
@pytest.mark.skipif(not MAPS.exists(), reason="Memory maps are counted by Linux alone.")
def test_memory_stays_flat_over_two_hundred_simulations():
    """Other numbers are no reason to compile: neither memory maps nor memory grow."""

    def held() -> tuple[int, float]:
        pages = int(PAGES.read_text().split()[1])
        return MAPS.read_bytes().count(b"\n"), pages * os.sysconf("SC_PAGE_SIZE") / 1e6

    for k in range(50):
        flown(1.0 + 0.001 * k)
    maps, megabytes = held()
    for k in range(200):
        flown(1.0 + 0.002 * k)
    maps_then, megabytes_then = held()
    assert maps_then <= maps + 10
    assert megabytes_then <= megabytes + 20


@pytest.mark.slow
def test_time_reversed_is_the_way_back():
    """A conservative four-bar whose velocities are turned round goes back to its start."""
    system = four_bar()
    start = four_bar_state(system, 2.0)
    method = stm.Method(rtol=1e-11, atol=1e-11)
    there = stm.simulate(system, start, ts=TIMES, method=method)
    end = jax.tree.map(lambda x: jnp.asarray(x[-1]), there.states)
    back = stm.simulate(
        system, stm.State(end.r, end.p, -end.v, -end.omega), ts=TIMES, method=method
    )
    home = jax.tree.map(lambda x: np.asarray(x[-1]), back.states)
    np.testing.assert_allclose(home.r, start.r, atol=1e-8)
    np.testing.assert_allclose(home.v, -np.asarray(start.v), atol=1e-7)
