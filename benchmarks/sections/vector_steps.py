"""Steps of many flights at once, beside crazyflow and rotorpy.

A step is one control period of 1/400 s with held inputs, from given starts, of all flights in one
compiled program: of hexacopters and of UAVs with tracker by `Plant.step`, and of each peer's own
quadrotor. With the rates stand the errors of one
step and of 0.1 s against eight times as many steps of RK4 of the same program in double precision.
Times are those of the processor.

The peers are in an environment of their own, since crazyflow excludes JAX 0.10.2:

    python3 -m venv venv-flight
    venv-flight/bin/pip install --group peers-flight      # pip 25.1 or later
    export STMUAV_FLIGHT_PEERS=venv-flight/bin/python
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from peers import flying
from peers.adapter import Peer
from sections.size import Size
from shared.clock import compiled

import stmuav_jax as stm

INTERPRETER = "STMUAV_FLIGHT_PEERS"
# What is run, and what is left out or done differently.
PEERS = {
    "crazyflow": ("`Sim` of cf21B_500, dynamics from first principles, commands of rotor speeds.",
                  "A quadrotor with its motor lag, drag and the rotors' momentum."),
    "rotorpy": ("`BatchedMultirotor` of a Crazyflie, commands of rotor speeds, PyTorch on one thread.",
                "A quadrotor with its motor lag and the rotors' drag; some arrays are single precision."),
}  # fmt: skip
MACHINES: dict[str, dict[str, Any]] = {
    "hexacopter": {"scene": "hexacopter"},
    "hexacopter with motor lag and drag": {
        "scene": "hexacopter", "options": {"drag": {}, "motor": {}},
    },
    "UAV with tracker": {"scene": "uav_tracker"},
}  # fmt: skip
RK4 = {"program": "stmuav-jax", "method": "rk4", "precision": "double"}


def ready(machine: dict[str, Any], flights: int, steps: int = 1) -> tuple[Any, Any, Any]:
    """Plant, its states at the starts, and inputs about those of a hover (flights, m)."""
    mission = stm.missions.make_mission({
        "format": 1, "name": "step", "t1": 1.0, "machine": machine, "rates": {"steps": steps},
    })  # fmt: skip
    plant = mission.plant
    first = plant.reset()
    reference = mission.references(jnp.zeros(()))
    hover, _ = mission.controller(first.estimate, reference, mission.controller.start())
    rotors = len(mission.machine.rotors.spin)
    at = flying.starts(flights, rotors)
    own = jnp.asarray(at.command) ** 2
    inputs = jnp.tile(hover, (flights, 1)).at[:, :rotors].multiply(own)

    def begun(r: Any, p: Any, v: Any, omega: Any) -> Any:
        return plant.reset(state0=moved(plant.state0, r, p, v, omega))

    quaternion = jnp.roll(jnp.asarray(at.quaternion), 1, axis=1)
    given = jnp.asarray(at.position), quaternion, jnp.asarray(at.velocity), jnp.asarray(at.omega)
    return plant, stm.math.outer_jit(lambda *of: jax.vmap(begun)(*of))(*given), inputs


def moved(state: stm.State, r: Any, p: Any, v: Any, omega: Any) -> stm.State:
    """State at rest moved as one rigid body to a pose of its first body, with velocities of that body."""
    rotation = stm.rotation
    R = rotation.rotation_matrix(p)
    # the first body is at the origin and level
    arms = (state.r - state.r[0]) @ R.T
    turning = R @ omega
    own = jax.vmap(lambda q: rotation.rotation_matrix(q).T @ turning)
    turned = jax.vmap(lambda q: rotation.product(p, q))(state.p)
    return stm.State(r + arms, turned, v + jnp.cross(turning, arms), own(turned))


def steps(plant: Any, inner: int, group: int) -> Any:
    """Function of states and inputs of all flights, `inner` steps of each, `group` of them side by side."""

    def one(now: Any, inputs: Any) -> Any:
        if inner == 1:
            return plant.step(now, inputs)
        return jax.lax.scan(lambda now, _: (plant.step(now, inputs), None), now, length=inner)[0]

    def all_of_them(now: Any, inputs: Any) -> Any:
        count = inputs.shape[0] // group
        folded = jax.tree.map(lambda x: x.reshape(count, group, *x.shape[1:]), (now, inputs))
        done = jax.lax.map(lambda given: jax.vmap(one)(*given), folded)
        return jax.tree.map(lambda x: x.reshape(count * group, *x.shape[2:]), done)

    return lambda now, inputs: (
        jax.vmap(one)(now, inputs) if len(inputs) == group else all_of_them(now, inputs)
    )


def rated(function: Any, given: tuple[Any, ...], size: Size, inner: int) -> dict[str, Any]:
    """Rate of a function of all flights, and the seconds to compile it."""
    program, seconds = compiled(function, *given, clock=time.process_time)
    call = lambda: jax.block_until_ready(program(*given))
    row = flying.rate_row(call, size.flights, inner, size.step_repeats)
    numbers = eqx.filter(call(), eqx.is_inexact_array)
    finite = all(bool(jnp.all(jnp.isfinite(x))) for x in jax.tree.leaves(numbers))
    failure = "" if finite else "Some numbers are not finite."
    return {**row, "compile_seconds": seconds, "failure": failure}


def poses(machine: dict[str, Any], flights: int, finer: int) -> dict[int, flying.Poses]:
    """Poses of the base after one period and after more."""
    plant, now, inputs = ready(machine, flights, finer)
    step = stm.math.outer_jit(lambda now, inputs: jax.vmap(plant.step)(now, inputs))

    def look(now: Any) -> flying.Poses:
        state = now.state
        return np.asarray(state.r)[:, 0], np.roll(np.asarray(state.p)[:, 0], -1, axis=1)

    return flying.after(lambda now: step(now, inputs), now, look)


def ours(size: Size) -> Iterator[dict[str, Any]]:
    """Rows of our machines, with all flights side by side, one step or several in a call, and in groups."""
    for name in list(MACHINES)[: size.machines]:
        machine = MACHINES[name]
        wrong = flying.errors(
            poses(machine, size.compared, 1), poses(machine, size.compared, flying.FINER)
        )
        plant, now, inputs = ready(machine, size.flights)
        for inner, group in ((1, size.flights), (size.inner, size.flights), (1, size.group)):
            row = rated(steps(plant, inner, group), (now, inputs), size, inner)
            yield {**RK4, "machine": name, "side_by_side": group, **row, **wrong}


def of_peer(name: str, size: Size) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """A peer for the table of programs and its rows; without rows, the reason why there are none."""
    interpreter = os.environ.get(INTERPRETER, sys.executable)
    wanted = (size.flights, size.compared, size.inner, size.step_repeats)
    # not this package's own options of XLA; crazyflow wants SciPy's arrays of other libraries
    own = {k: v for k, v in os.environ.items() if k not in ("XLA_FLAGS", "PYTHONPATH")}
    own["SCIPY_ARRAY_API"] = "1"
    done = subprocess.run(
        [interpreter, flying.__file__, name, *map(str, wanted)],
        capture_output=True, text=True, check=False, env=own,
    )  # fmt: skip
    if done.returncode:
        lines = done.stderr.strip().splitlines() or ["no message"]
        said = next((line for line in reversed(lines) if "Error" in line), lines[-1])
        where = INTERPRETER if INTERPRETER in os.environ else "the suite's own interpreter"
        return {"method": name, "reason": f"Not run with {where}: {said}"}, []
    found = json.loads(done.stdout.strip().splitlines()[-1])
    how, caveat = PEERS[name]
    about = {"method": name, "version": found["version"], "how": how, "caveats": [caveat]}
    rows = [
        {"program": name, "machine": "its quadrotor", **row, "failure": ""} for row in found["rows"]
    ]
    return about, rows


def vector_steps(size: Size, there: list[Peer]) -> dict[str, Any]:
    """The section; other programs are run if the suite compares at all."""
    content: dict[str, Any] = {
        "what": f"{size.flights} flights in one call, one control period of 1/{flying.RATE:g} s each, on one core",
        "horizon": flying.HORIZON / flying.RATE, "peers": [], "skipped": [], "rows": [],
    }  # fmt: skip
    for name in PEERS if there else ():
        about, rows = of_peer(name, size)
        content["rows"] += rows
        content["peers" if rows else "skipped"].append(about)
    for row in ours(size):
        print(row, flush=True)
        content["rows"].append(row)
    return content
