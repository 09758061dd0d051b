"""One free body as a user runs it, against the same body written by hand."""

from typing import Any

import diffrax
import jax.numpy as jnp
import numpy as np
from peers.adapter import Peer
from sections.size import Size
from shared.clock import compiled, measure
from shared.methods import trajectory

import stmuav_jax as stm
from stmuav_jax.math.rotation import rotation_matrix
from stmuav_jax.uav.rotor import Rotors

TOLERANCES = (1e-6, 1e-8, 1e-10)


def by_hand(scene: stm.Scene) -> Any:
    """The 13 equations of the scene's one body under constant rotor speeds, written out.

    (state (13,), end, tolerance) -> (state, steps). The quaternion is not normalised.
    """
    bodies, forces = scene.system.bodies, scene.system.forces
    mass, inertia = bodies.mass[0], bodies.inertia[0]
    inverse = jnp.linalg.inv(inertia)
    rotors = next(f for f in forces if isinstance(f, Rotors))
    gravity = next(f for f in forces if isinstance(f, stm.Gravity)).acceleration
    assert not callable(rotors.speed_squared)
    wrench = rotors.wrench(rotors.speed_squared, bodies.com[0])

    def field(t: Any, x: Any, args: Any) -> Any:
        del t, args
        p, omega = x[3:7], x[10:]
        wx, wy, wz = omega
        p_rate = 0.5 * jnp.stack([
            -p[1] * wx - p[2] * wy - p[3] * wz, p[0] * wx + p[2] * wz - p[3] * wy,
            p[0] * wy + p[3] * wx - p[1] * wz, p[0] * wz + p[1] * wy - p[2] * wx,
        ])  # fmt: skip
        v_rate = rotation_matrix(p) @ wrench[:3] / mass + gravity
        omega_rate = inverse @ (wrench[3:] - jnp.cross(omega, inertia @ omega))
        return jnp.concatenate([x[7:10], p_rate, v_rate, omega_rate])

    def solve(x: Any, end: Any, tolerance: Any) -> Any:
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(field), diffrax.Dopri8(), jnp.zeros(()), end, 1e-4, x,
            saveat=diffrax.SaveAt(t1=True),
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
            adjoint=diffrax.ForwardMode(), max_steps=100_000, throw=False,
        )  # fmt: skip
        assert solution.ys is not None
        return solution.ys[0], solution.stats["num_steps"]

    return solve


def run_times(
    name: str, function: Any, x0: Any, end: Any, size: Size
) -> tuple[list[dict[str, Any]], np.ndarray]:
    """Rows of one way to write the body, for all tolerances; and its end at the tightest."""
    program, seconds = compiled(function, x0, end, jnp.asarray(TOLERANCES[0]))
    rows, x = [], np.asarray(x0)
    for tolerance in TOLERANCES:
        at = jnp.asarray(tolerance)
        timing, (x, steps) = measure(
            lambda at=at: program(x0, end, at), repeats=20 * size.repeats, budget=size.budget
        )
        rows.append({
            "method": name, "tolerance": tolerance, "seconds": timing.to_dict(),
            "compile_seconds": seconds, "steps": int(steps),
            "seconds_per_step": timing.median / max(int(steps), 1),
            "quaternion_norm_error": abs(float(np.linalg.norm(x[3:7])) - 1),
            "failure": "" if np.all(np.isfinite(x)) else "The state is not finite.",
        })  # fmt: skip
        print(f"  {name} {tolerance:.0e}: {1e6 * timing.median:.0f} us, {steps} steps", flush=True)
    return rows, np.asarray(x)


def hexacopter(size: Size, others: list[Peer]) -> dict[str, Any]:
    """What the generality costs on one free body, where nothing of it is needed."""
    scene = stm.make_scene("hexacopter")
    state, end = scene.state0, jnp.asarray(size.span)
    flat = jnp.concatenate([x[0] for x in (state.r, state.p, state.v, state.omega)])
    general = trajectory(stm.Tree(), diffrax.Dopri8())

    # both get their numbers as constants and only a start, so that calls cost the same
    def ours(x: Any, end: Any, tolerance: Any) -> Any:
        start = stm.State(x[None, :3], x[None, 3:7], x[None, 7:10], x[None, 10:])
        path = general(scene.system, start, jnp.stack([jnp.zeros(()), end]), tolerance)
        last = [y[-1, 0] for y in (path.states.r, path.states.p, path.states.v, path.states.omega)]
        return jnp.concatenate(last), path.counts.accepted[-1] + path.counts.rejected[-1]

    mine, x = run_times("stmuav-jax, tree", ours, flat, end, size)
    theirs, y = run_times("by hand", by_hand(scene), flat, end, size)
    return {
        "what": "hexacopter against 13 equations by hand in diffrax, Dopri8; the latter does "
        "not normalise its quaternion and watches no residual",
        "span": size.span, "rows": mine + theirs,
        "ends_differ": float(np.linalg.norm(x[:3] - y[:3])),
    }  # fmt: skip
