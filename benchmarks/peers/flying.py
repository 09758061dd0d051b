"""Batched steps of crazyflow and rotorpy, each with its own quadrotor, in the interpreter that has them.

    python benchmarks/peers/flying.py crazyflow 4096 256 20

crazyflow excludes the version of JAX that this package needs, so that both are never in one
environment: this module imports neither this package nor JAX before it is asked to, and prints JSON.
`sections/vector_steps.py` starts it, and takes starts, timer and errors from it, so that all programs have the same.
"""

import importlib
import json
import statistics
import sys
import time
from collections.abc import Callable
from importlib import metadata
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

RATE = 400.0  # control periods per second [Hz]
HORIZON = 40  # periods after which errors are looked at again
FINER = 8  # steps of a reference in a period
BUDGET = 2.0  # a call is not repeated once this much is spent on it [s of the clock]
GRAVITY = 9.81

Row = dict[str, Any]
Poses = tuple[np.ndarray, np.ndarray]  # positions (k, 3) [m], quaternions, scalar last (k, 4)


class Starts(NamedTuple):
    """Starts of k flights that each program is given, rounded to single precision.

    Attributes:
        position, velocity: of the base, world (k, 3) [m, m/s]. quaternion: scalar last (k, 4).
        omega: angular velocity, body (k, 3) [rad/s]. command: rotor speeds over those of hover (k, m).
    """

    position: np.ndarray
    velocity: np.ndarray
    quaternion: np.ndarray
    omega: np.ndarray
    command: np.ndarray


def starts(count: int, rotors: int) -> Starts:
    """Flights some 10 m above the ground, tilted by 0.2 rad, with 1 m/s and 1 rad/s (one sigma)."""
    rng = np.random.default_rng(1)
    normal = lambda *sizes: rng.normal(size=(count, *sizes))
    single = lambda x: np.asarray(x, np.float32).astype(float)
    turned = single(Rotation.from_rotvec(0.2 * normal(3)).as_quat())
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    return Starts(
        single(normal(3) + np.array([0.0, 0.0, 10.0])), single(normal(3)), turned, single(normal(3)),
        single(1.0 + 0.01 * normal(rotors)),
    )  # fmt: skip


def seconds_of(call: Callable[[], Any], repeats: int) -> tuple[float, float, int]:
    """Median seconds of processor time of a call that waits for its output, quartiles' distance, repeats.

    The first call is a warm-up.
    """
    call()
    spent: list[float] = []
    began = time.perf_counter()
    while len(spent) < repeats and (not spent or time.perf_counter() - began < BUDGET):
        clock = time.process_time()
        call()
        spent.append(time.process_time() - clock)
    if len(spent) < 2:
        return spent[0], 0.0, 1
    low, middle, high = statistics.quantiles(spent, n=4, method="inclusive")
    return middle, high - low, len(spent)


def rate_row(call: Callable[[], Any], flights: int, inner: int, repeats: int) -> Row:
    """Steps per second of a call that takes `inner` steps of all flights."""
    middle, spread, times = seconds_of(call, repeats)
    return {
        "flights": flights, "steps_per_call": inner, "seconds": middle, "spread": spread,
        "repeats": times, "per_second": flights * inner / middle,
    }  # fmt: skip


def errors(found: dict[int, Poses], reference: dict[int, Poses]) -> Row:
    """Largest distances [m] and angles [rad] from a reference, by the number of periods."""
    row: Row = {}
    for periods, (position, quaternion) in found.items():
        true = reference[periods]
        apart = np.linalg.norm(position - true[0], axis=1)
        between = Rotation.from_quat(quaternion).inv() * Rotation.from_quat(true[1])
        named = "one" if periods == 1 else "many"
        row[f"position_error_{named}"] = float(np.max(apart))
        row[f"angle_error_{named}"] = float(np.max(between.magnitude()))
    return row


def after(step: Callable[[Any], Any], now: Any, look: Callable[[Any], Poses]) -> dict[int, Poses]:
    """Poses after one period and after `HORIZON` of them."""
    found = {}
    for k in range(1, HORIZON + 1):
        now = step(now)
        if k in (1, HORIZON):
            found[k] = look(now)
    return found


def crazyflow(flights: int, compared: int, inner: int, repeats: int) -> list[Row]:
    """crazyflow's `Sim`: Euler's method, its default, and RK4, in single and in double precision."""
    import jax

    rows, found = [], {}
    for precision in ("single", "double"):
        jax.config.update("jax_enable_x64", precision == "double")
        for method in ("euler", "rk4"):
            about = {"method": method, "precision": precision}
            for steps in (1, inner):
                sim, data = _crazyflow(flights, method, RATE)
                call = lambda sim=sim, data=data, n=steps: jax.block_until_ready(
                    sim._step(data, n_steps=n)
                )
                clock = time.process_time()
                call()
                compiling = time.process_time() - clock
                row = rate_row(call, flights, steps, repeats)
                rows.append({**about, **row, "compile_seconds": compiling})
            found[precision, method] = _crazyflow_after(compared, method, 1)
    # the last precision is double
    true = _crazyflow_after(compared, "rk4", FINER)
    return [{**row, **errors(found[row["precision"], row["method"]], true)} for row in rows]


def _crazyflow(flights: int, method: str, rate: float) -> tuple[Any, Any]:
    """Simulator, and its data at the starts."""
    import jax.numpy as jnp

    sim = importlib.import_module("crazyflow.sim").Sim(
        n_worlds=flights, dynamics="first_principles", control="rotor_vel", integrator=method,
        freq=round(rate),
    )  # fmt: skip
    given = importlib.import_module("crazyflow.dynamics").load_params("first_principles", sim.drone)
    k0, k1, k2 = (float(x) for x in np.ravel(given["rpm2thrust"])[:3])
    hover = np.roots([k2, k1, k0 - float(np.ravel(given["mass"])[0]) * GRAVITY / 4]).max()
    at, kind = starts(flights, 4), sim.data.states.pos.dtype
    array = lambda x: jnp.asarray(np.asarray(x)[:, None], kind)
    states = sim.data.states.replace(
        pos=array(at.position), quat=array(at.quaternion), vel=array(at.velocity),
        ang_vel=array(at.omega), rotor_vel=array(np.full((flights, 4), hover)),
    )  # fmt: skip
    controls = sim.data.controls.replace(rotor_vel=array(hover * at.command))
    return sim, sim.data.replace(states=states, controls=controls)


def _crazyflow_after(flights: int, method: str, finer: int) -> dict[int, Poses]:
    sim, data = _crazyflow(flights, method, finer * RATE)
    array = lambda x: np.asarray(x, float)[:, 0]
    look = lambda data: (array(data.states.pos), array(data.states.quat))
    return after(lambda data: sim._step(data, n_steps=finer), data, look)


def rotorpy(flights: int, compared: int, inner: int, repeats: int) -> list[Row]:
    """rotorpy's `BatchedMultirotor`: one step of RK4, and Dormand and Prince's adaptive steps."""
    torch = importlib.import_module("torch")
    torch.set_num_threads(1)
    rows, found = [], {}
    for method in ("rk4", "dopri5"):
        step, now, _ = _rotorpy(flights, method, 1 / RATE)
        row = rate_row(lambda step=step, now=now: step(now), flights, 1, repeats)
        about = {"method": method, "precision": "double, parts of it single"}
        rows.append({**about, **row, "compile_seconds": None})
        found[method] = _rotorpy_after(compared, method, 1)
    # single precision is torch's default, which some of rotorpy's arrays have
    torch.set_default_dtype(torch.float64)
    true = _rotorpy_after(compared, "rk4", FINER)
    return [{**row, **errors(found[row["method"]], true)} for row in rows]


def _rotorpy(flights: int, method: str, h: float) -> tuple[Any, Any, Any]:
    """Function of the state that steps over h [s], the state at the starts, and a function to look at it."""
    torch = importlib.import_module("torch")
    quad_params = importlib.import_module("rotorpy.vehicles.crazyflie_params").quad_params
    vehicles = importlib.import_module("rotorpy.vehicles.multirotor")
    device = torch.device("cpu")
    at, array = starts(flights, 4), lambda x: torch.from_numpy(np.array(x, float))
    hover = float(np.sqrt(quad_params["mass"] * GRAVITY / 4 / quad_params["k_eta"]))
    now = {
        "x": array(at.position), "v": array(at.velocity), "q": array(at.quaternion),
        "w": array(at.omega), "wind": array(np.zeros((flights, 3))),
        "rotor_speeds": array(np.full((flights, 4), hover)),
    }  # fmt: skip
    own = vehicles.BatchedMultirotorParams([quad_params] * flights, flights, device)
    machine = vehicles.BatchedMultirotor(own, flights, now, device, integrator=method)
    command = {"cmd_motor_speeds": array(hover * at.command)}
    look = lambda now: (now["x"].numpy(), now["q"].numpy())
    return lambda now: machine.step(now, command, h), now, look


def _rotorpy_after(flights: int, method: str, finer: int) -> dict[int, Poses]:
    step, now, look = _rotorpy(flights, method, 1 / (finer * RATE))

    def period(now: Any) -> Any:
        for _ in range(finer):
            now = step(now)
        return now

    return after(period, now, look)


def main() -> None:
    """Measure one program, and print its version and rows as the last line."""
    name, *sizes = sys.argv[1:]
    rows = {"crazyflow": crazyflow, "rotorpy": rotorpy}[name](*map(int, sizes))
    print(json.dumps({"version": metadata.version(name), "rows": rows}))


if __name__ == "__main__":
    main()
