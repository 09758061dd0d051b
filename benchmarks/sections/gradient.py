"""Gradients of the seven-body UAV: what they cost, and how far they are from the truth."""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from peers.adapter import Peer
from problems.compared import moving_base, tracker
from sections.precision import reason
from sections.size import Size
from shared.clock import compiled, measure
from shared.methods import trajectory

import stmuav_jax as stm
from stmuav_jax.uav.rotor import Rotors

DIFFERENCES = (4e-3, 2e-3, 1e-3)
PARAMETERS = (
    "seven masses, the base's initial velocity [m/s] and angular velocity [rad/s] (three each), six "
    "squared rotor speeds and gravity; changes of the others are relative"
)


def disturb(scene: stm.Scene, change: Any) -> tuple[stm.System, stm.State]:
    """System and start for changes (20,), in the order of `PARAMETERS`."""
    system = scene.system
    gravity = next(k for k, f in enumerate(system.forces) if isinstance(f, stm.Gravity))
    rotors = next(k for k, f in enumerate(system.forces) if isinstance(f, Rotors))
    of = lambda s: (s.bodies.mass, s.forces[rotors].speed_squared, s.forces[gravity].acceleration)
    mass, speeds, pull = of(system)
    new = mass * (1 + change[:7]), speeds * (1 + change[13:19]), pull * (1 + change[19])
    changed = eqx.tree_at(of, system, new)
    tree = stm.Tree()
    model = tree.prepare(system)
    x = moving_base(model, tree.to_vector(model, scene.state0), change[7:10], change[10:13])
    return changed, tree.to_state(model, x)


def functional(scene: stm.Scene, end: float, count: int, adjoint: Any, steps: int) -> Any:
    """(changes (count,), tolerance) -> final position of the panel (3,) [m]."""
    run = trajectory(stm.Tree(), diffrax.Dopri8(), adjoint, steps)
    ts = jnp.array([scene.t0, end])
    panel = scene.system.index("panel_7")

    def of(change: Any, tolerance: Any) -> Any:
        everything = jnp.zeros(20).at[:count].set(change)
        system, state = disturb(scene, everything)
        return run(system, state, ts, tolerance).states.r[-1, panel]

    return of


def differences(of: Callable[[Any], Any], count: int) -> tuple[np.ndarray, float]:
    """Jacobian (3, count) by central differences, twice extrapolated; and its last change."""
    central = lambda step, h: (np.asarray(of(h * step)) - np.asarray(of(-h * step))) / (2 * h)
    levels = [np.stack([central(e, h) for e in jnp.eye(count)], axis=1) for h in DIFFERENCES]
    once = [(4 * b - a) / 3 for a, b in itertools.pairwise(levels)]
    twice = (16 * once[1] - once[0]) / 15
    return twice, float(np.max(np.abs(twice - once[1])) / np.max(np.abs(twice)))


# What a mode's value is to be, of the whole Jacobian (3, count); None for the simulation itself.
Wanted = Callable[[np.ndarray], np.ndarray] | None


class Mode(NamedTuple):
    """(changes, tolerance) -> value, what that is to be, and the number of flights at once."""

    of: Callable[..., Any]
    wanted: Wanted = None
    flights: int = 1


def modes(scene: stm.Scene, size: Size) -> dict[str, Mode]:
    n, end = size.parameters, size.gradient_horizon
    ahead = functional(scene, end, n, diffrax.ForwardMode(), 100_000)
    back = functional(scene, end, n, stm.dynamics.DiscreteAdjoint(), 100_000)
    height = lambda change, tolerance: back(change, tolerance)[2]
    one = jnp.ones(n)
    along = lambda change, tolerance: jax.jvp(lambda c: ahead(c, tolerance), (change,), (one,))[1]
    batched = lambda of: jax.vmap(of, (0, None))
    many, of_height = size.group, lambda exact: exact[2]
    return {
        "simulation": Mode(ahead),
        "forward (jvp), one direction": Mode(along, lambda exact: exact.sum(axis=1)),
        "forward (jacfwd), all three components": Mode(jax.jacfwd(ahead), lambda exact: exact),
        "reverse (grad), height": Mode(jax.grad(height), of_height),
        f"simulation, each of {many}": Mode(batched(ahead), None, many),
        f"reverse (grad), height, each of {many}": Mode(batched(jax.grad(height)), of_height, many),
    }


def gradient(size: Size, others: list[Peer]) -> dict[str, Any]:
    """Forward and reverse mode against one simulation and against central differences."""
    scene = tracker(size.horizons).scene
    zero, tight = jnp.zeros(size.parameters), jnp.asarray(max(size.reference, 1e-13))
    rows: list[dict[str, Any]] = []
    exact, own = np.zeros((3, size.parameters)), float("nan")
    base: dict[float, float] = {}
    for name, (of, wanted, flights) in modes(scene, size).items():
        at_start = zero if flights == 1 else jnp.zeros((flights, size.parameters))
        jit = stm.math.quick_jit if flights == 1 else stm.math.outer_jit
        try:
            program, seconds = compiled(of, at_start, tight, jit=jit)
        except Exception as error:
            rows.append({"mode": name, "failure": reason(error)})
            continue
        if name == "simulation":
            exact, own = differences(lambda c, p=program: p(c, tight), size.parameters)
        for tolerance in size.gradient_tolerances:
            at = jnp.asarray(tolerance)
            timing, value = measure(
                lambda p=program, x=at_start, at=at: p(x, at),
                repeats=size.repeats,
                budget=size.budget,
            )
            each, value = timing.median / flights, value if flights == 1 else value[0]
            base.setdefault(tolerance, each)
            error = None
            if wanted is not None:
                want = wanted(exact)
                error = float(np.max(np.abs(value - want)) / np.max(np.abs(want)))
            row = {
                "mode": name, "tolerance": tolerance, "seconds": timing.to_dict(),
                "flights": flights, "compile_seconds": seconds,
                "cost_in_simulations": each / base[tolerance], "error": error,
                "failure": "" if np.all(np.isfinite(value)) else "The gradient is not finite.",
            }  # fmt: skip
            rows.append(row)
            said = f"{row['cost_in_simulations']:.1f} simulations, error {row['error']}"
            print(f"  {name} {tolerance:.0e}: {1e3 * each:.2f} ms, {said}", flush=True)
    return {
        "what": "gradient of the panel's final position, uav_tracker case 2, tree, Dopri8",
        "horizon": size.gradient_horizon, "parameters": PARAMETERS, "count": size.parameters,
        "differences": {"steps": DIFFERENCES, "own_error": own}, "rows": rows,
    }  # fmt: skip
