"""Machine code against XLA's for several mechanisms, for a filter on the simulator, and for trims.

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 taskset -c 1 python benchmarks/by_mechanism.py

Right-hand sides by spanning-tree coordinates, singly and in a batch; the filter estimates motion and mass
of the panel of the UAV with its tracker from a gyroscope, an accelerometer and the sliders' encoders, alone
and in a bank. Both kinds of code are measured in one process, in seconds of the processor, with the largest
difference of their results relative to the largest number.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import machine_code
import numpy as np
import trims
from shared.clock import compiled, measure_processor
from shared.record import ROOT, benchmark

import stmuav_jax as stm
from stmuav_jax.dynamics.integration.problem import _get_derivative


@dataclass(frozen=True)
class Size:
    """states: of a batch; hinges: of the chain; filters: of the bank; steps: of a filter; orientations:
    of the trims; group: trims at once; repeats.
    """

    states: int = 64
    hinges: int = 30
    filters: int = 64
    steps: int = 10
    orientations: int = 2000
    group: int = 64
    repeats: int = 5


QUICK = Size(3, 3, 2, 2, 6, 2, 1)


def chain(hinges: int) -> stm.System:
    """Rods that hang one on the other by hinges, whose axes alternate."""
    names = ["ground", *(f"rod {k}" for k in range(hinges))]
    bodies = [
        stm.Body(name, mass=1.0, inertia=[0.02, 0.03, 0.04], position=(k + 0.5, 0.0, 0.0))
        for k, name in enumerate(names[1:])
    ]
    axes = ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0))
    joints = [
        stm.revolute(f"hinge {k}", *names[k : k + 2], point=(k, 0.0, 0.0), axis=axes[k % 2])
        for k in range(hinges)
    ]
    return stm.System(bodies, joints, [stm.Gravity()])


def stewart_platform() -> stm.System:
    """A platform of 20 kg on six legs, each a barrel and a rod with universal and spherical joints."""
    bodies = [stm.Body("platform", 20.0, [1.0, 1.2, 1.8], position=(0.0, 0.0, 1.25))]
    joints = []
    for k in range(6):
        angles = k * np.pi / 3 + np.array([0.15, -0.25]) * (-1) ** k
        foot, head = (
            np.array([radius * np.cos(angle), radius * np.sin(angle), height])
            for radius, angle, height in zip((1.0, 0.6), angles, (0.0, 1.2), strict=True)
        )
        along = (head - foot) / np.linalg.norm(head - foot)
        across = np.cross(along, [0.0, 0.0, 1.0])
        across /= np.linalg.norm(across)
        barrel, rod = f"barrel {k}", f"rod {k}"
        bodies += [
            stm.Body(name, mass, [0.01] * 3, position=foot + share * (head - foot))
            for name, mass, share in ((barrel, 0.8, 0.25), (rod, 0.5, 0.75))
        ]
        joints += [
            stm.universal(
                f"foot {k}",
                "ground",
                barrel,
                point=foot,
                axis_i=across,
                axis_j=np.cross(along, across),
            ),
            stm.translational(f"slide {k}", barrel, rod, point=(foot + head) / 2, axis=along),
            stm.spherical(f"head {k}", rod, "platform", point=head),
        ]
    return stm.System(bodies, joints, [stm.Gravity()])


def make_systems(size: Size) -> dict[str, stm.System]:
    """Mechanisms of one body to thirty, by their names in the table."""
    model = lambda name: stm.io.load_model(ROOT / "docs" / "models" / f"{name}.toml").system
    return {
        "hexacopter": stm.make_scene("hexacopter").system,
        "four-bar": model("four_bar"),
        "delta robot": model("delta_robot"),
        "hexacopter with tracker": stm.make_scene("uav_tracker", case=2).system,
        "Stewart platform": stewart_platform(),
        f"chain of {size.hinges} hinges": chain(size.hinges),
    }


def measure_system(size: Size, system: stm.System, states: int) -> dict[str, Any]:
    """Microseconds per state of the right-hand side by both kinds of code."""
    formulation, zero = stm.Tree(), jnp.zeros(())
    model, rng = formulation.prepare(system), np.random.default_rng(0)
    start = np.asarray(formulation.to_vector(model, system.reference))
    starts = jnp.asarray(start + 1e-3 * rng.normal(size=(states, len(start))))
    rate = lambda model, x: _get_derivative(formulation, model, zero, x, stm.Unstabilised())[0]
    timing = machine_code.Size(repeats=size.repeats)
    return machine_code.both(lambda: machine_code.evaluated(rate, model, starts, timing), "last")


# The filter: deviations of the start and of a step's noise for r, attitude, panel angles, v, omega, their
# rates, and the panel's mass over its own; those of gyroscope [rad/s], accelerometer [m/s^2], encoders [m].
PARTS = (3, 3, 2, 3, 3, 2, 1)
START = np.repeat([0.1, 0.005, 0.02, 0.1, 0.05, 0.05, 0.1], PARTS)
WANDER = np.repeat([0.0, 0.0, 0.0, 0.01, 0.02, 0.02, 0.0], PARTS)
NOISE = np.repeat([0.01, 0.05, 5e-4], (3, 3, 2))
STEP = 0.02


def make_filter() -> tuple[Any, Any, jax.Array]:
    """Model of the UAV with its sensors, the prior, and the inputs at which it hovers."""
    uav = stm.uav.make_uav()
    panel, sensing = uav.system.index("panel_7"), stm.analysis
    mass = uav.system.bodies.mass

    def adapt(space: Any, numbers: jax.Array) -> Any:
        system = eqx.tree_at(
            lambda s: s.bodies.mass, space.system, mass.at[panel].multiply(numbers[0])
        )
        return space.with_system(system)

    base = "hexacopter_1"
    sensors = [
        sensing.Gyroscope(base), sensing.Accelerometer(base), sensing.Encoder("T12"), sensing.Encoder("T13"),
    ]  # fmt: skip
    model = sensing.system_model(
        uav.space, sensors, Q=WANDER**2, R=NOISE**2, inputs=uav.inputs, adapt=adapt,
        parameters=["mass of the panel over its own"],
    )  # fmt: skip
    start = {"motion": uav.space.from_state(uav.system.reference), "parameters": jnp.ones(1)}
    hover = stm.uav.trim_flight(uav, stm.analysis.hover(jnp.zeros(2)))
    return model, stm.estimation.gaussian(start, np.diag(START**2)), hover.values


def simulate_readings(size: Size, model: Any, prior: Any, u: jax.Array) -> np.ndarray:
    """Readings with noise (steps, components, filters) of motions that begin at random."""
    rng = np.random.default_rng(7)
    draw = lambda sizes, *count: (
        sizes[:, None] * rng.normal(size=(*count, len(sizes), size.filters))
    )
    x = model.space.retract(jax.tree.map(lambda a: a[:, None], prior.mean), draw(START))

    def step(x: Any, w: jax.Array) -> tuple[Any, jax.Array]:
        x = model.space.retract(model(x, u, STEP), w)
        return x, model.sensor(x, u)

    readings = stm.math.outer_jit(lambda x, w: jax.lax.scan(step, x, w)[1])
    return np.asarray(readings(x, draw(WANDER, size.steps))) + draw(NOISE, size.steps)


def measure_filter(size: Size, filters: int, inputs: tuple[Any, ...]) -> dict[str, Any]:
    """Microseconds per step and filter, seconds to compile, and the means at the end."""
    model, prior, u, readings = inputs
    run = stm.estimation.filter_bank if filters > 1 else stm.estimation.kalman_filter
    y = jnp.asarray(readings if filters > 1 else readings[:, :, 0])
    us = jnp.broadcast_to(u, (size.steps, len(u)))
    # the shared times of a bank are known numbers: its arguments are the readings alone
    program, seconds = compiled(
        lambda y: run(model, prior, y, u=us, dt=STEP), y, clock=time.process_time
    )
    timing, result = measure_processor(lambda: program(y), repeats=size.repeats)
    means = np.concatenate(
        [np.ravel(leaf) for leaf in jax.tree.leaves(result.mean) if leaf.ndim > 1]
    )
    best = 1e6 * timing.best / (size.steps * filters)
    return {"us_per_step": best, "compile_seconds": seconds, "means": means}


def measure_trims(size: Size) -> dict[str, Any]:
    """Hover trims per second, seconds to compile, and the inputs of those that are valid."""
    uav, rng = stm.uav.make_uav(), np.random.default_rng(0)
    angles = jnp.asarray(rng.uniform(-trims.REACH, trims.REACH, (size.orientations, 2)))
    find = lambda a: trims.trim_all(uav, a, size.group)
    program, seconds = compiled(find, angles, clock=time.process_time)
    timing, (reason, _, _, values) = measure_processor(
        lambda: program(angles), repeats=size.repeats
    )
    valid = np.asarray(reason) == stm.uav.TrimReason.VALID
    return {
        "per_second": len(angles) / timing.best, "compile_seconds": seconds, "valid": int(valid.sum()),
        "values": np.asarray(values)[valid],
    }  # fmt: skip


def record(size: Size) -> Iterator[dict[str, Any]]:
    """A row for each mechanism and number of states, then the filter's and the trims."""
    content: dict[str, Any] = {
        "what": "machine code against XLA's by mechanism, in filters and in trims", "rows": [], "filters": [],
    }  # fmt: skip
    for name, system in make_systems(size).items():
        for states in (1, size.states):
            row = {"name": name, "bodies": system.n_bodies, "states": states}
            content["rows"].append({**row, **measure_system(size, system, states)})
            print(content["rows"][-1], flush=True)
            yield content
    model, prior, u = make_filter()
    inputs = (model, prior, u, simulate_readings(size, model, prior, u))
    for filters in (1, size.filters):
        timed: Callable[[], Any] = lambda k=filters: measure_filter(size, k, inputs)
        content["filters"].append({"filters": filters, **machine_code.both(timed, "means")})
        print(content["filters"][-1], flush=True)
        yield content
    content["trims"] = machine_code.both(lambda: measure_trims(size), "values")
    yield content


if __name__ == "__main__":
    benchmark("by_mechanism", __doc__, record, (Size(), QUICK))
