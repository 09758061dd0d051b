"""Hover of the quadrotor under a controller that uses only the filter's estimate.

In the eight cases of the report the quadrotor spins up without bound. Here a controller of
position and tilt (proportional, with damping) holds it, and compensates the moment of the thrust
about the estimated centre of mass. The filter has 14 error states,

    rotation (3), omega (3), offset (2), r of the epicentre, v of the centre of mass (3 each, world),

    m v' = m g + R_wb F e_z,    (r + R_wb c)' = v,  c = (offset, 0),    and attitude.py for the rest,

and measures body rates and, by motion capture, r. (With the position of the centre of mass as a
state, the measurement would contain the product of the errors of attitude and offset, 1 cm at
the start, which no rule of third degree accounts for.) Yaw is not controlled, since the report's
rotor moments cancel.

Each rotor's thrust is limited to between 0 and a largest value, and the filter's inputs are the
limited thrusts. Parameters that Part III does not have are in `Loop`. `stm.sensing.system_model` has
the position of a body's centre of mass as the state, which is why the filter here keeps a model of
its own.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..algebra.compiler import outer_jit
from ..algebra.rotation import cross, from_rotation_vector, rotation_matrix
from ..algebra.space import Composite, Rotation, Vector
from ..algebra.stacked import apply, apply_transposed, dot
from ..checks.errors import SettingError
from ..estimation.consistency import nees
from ..estimation.filter import is_finite
from ..estimation.gaussians import Gaussian, gaussian
from ..estimation.model import Sensor, StateSpaceModel
from ..estimation.update import DEFAULT, Innovation
from ..parameters.table import Parameters
from .attitude import ATTITUDE_NAMES, attitude_model
from .cases import check_room, check_seeds
from .filter_verdict import RunsVerdict, judge, over_runs
from .model import PART_III, matrix, offsets
from .tuning import FOLLOWING, WIDE, TuningName

HOVER_NAMES = (
    *ATTITUDE_NAMES,
    *(f"{what}_{axis}" for what in ("r", "v") for axis in "xyz"),
)
_GRAVITY = 9.81


class Loop(eqx.Module):
    """Chosen parameters of controller, sensors and disturbances of the hover.

    Attributes:
        position, velocity: gains of the position controller [1/s^2, 1/s].
        tilt, rate: gains of the tilt controller [1/s^2, 1/s].
        thrust: largest thrust of a rotor [N].
        position_noise: standard deviation of a measured position [m].
        velocity_noise: standard deviation of the velocity's change in one step [m/s].
        initial_tilt, initial_velocity: standard deviations of attitude [rad] and velocity [m/s] at the start.
        substeps: number of substeps of the true motion in each step.
    """

    position: float = 4.0
    velocity: float = 4.0
    tilt: float = 100.0
    rate: float = 20.0
    thrust: float = 20.0
    position_noise: float = 2e-3
    velocity_noise: float = 1e-3
    initial_tilt: float = 0.02
    initial_velocity: float = 0.1
    substeps: int = eqx.field(static=True, default=4)


class Hover(eqx.Module):
    """Results of a hover over T steps for s seeds.

    Attributes:
        t, thrust: times (T + 1,) [s] and thrusts of the rotors (T, 4, s) [N].
        truth, mean, standard_deviation: true values, estimates and standard deviations of (omega, offset)
            after each step (T, 5, s).
        r, tilt: true position of the epicentre (T, 3, s) [m], and angle of the rotors' axis from
            the vertical (T, s) [rad].
        nees, nees_offset: NEES of all 14 error states and of the offset (T, s).
        nis: NIS (T, s), infinite from a failure on.
        ok: False from the step at which a filter failed (T, s).
        normalised, measured: normalised innovations, and True for those not missing (T, 6, s).
    """

    t: Float[Array, " t"]
    thrust: Float[Array, "T 4 s"]
    truth: Float[Array, "T 5 s"]
    mean: Float[Array, "T 5 s"]
    standard_deviation: Float[Array, "T 5 s"]
    r: Float[Array, "T 3 s"]
    tilt: Float[Array, "T s"]
    nees: Float[Array, "T s"]
    nees_offset: Float[Array, "T s"]
    nis: Float[Array, "T s"]
    ok: Bool[Array, "T s"]
    normalised: Float[Array, "T 6 s"]
    measured: Bool[Array, "T 6 s"]

    def verdict(self) -> RunsVerdict:
        """Verdict on the filter over all seeds, from its innovations."""
        return over_runs(judge(self.normalised, self.measured, self.ok, np.diff(self.t)))


def hover_space() -> Composite:
    """Space of points {p, omega, offset, r, v}, whose errors have 14 components."""
    return Composite(p=Rotation(), omega=Vector(3), offset=Vector(2), r=Vector(3), v=Vector(3))


def arm(p: Float[Array, "4 *s"], offset: Float[Array, "2 *s"]) -> Float[Array, "3 *s"]:
    """Vector from the epicentre to the centre of mass in the world [m]."""
    R_wb = rotation_matrix(p)
    return R_wb[:, 0] * offset[:1] + R_wb[:, 1] * offset[1:]


def hover_model(Q: Any, R: Any, *, parameters: Parameters = PART_III) -> StateSpaceModel:
    """State-space model of the module, whose inputs are the four thrusts [N].

    Args:
        Q: covariance of the process noise (14,) or (14, 14), per step.
        R: covariance of the noise of body rates and position (6,) or (6, 6).
    """
    turning = attitude_model(np.ones(8), np.ones(3), parameters=parameters)
    mass = parameters.value("mass")

    def lifted(p: Array, u: Array) -> Array:
        """Acceleration of the centre of mass [m/s^2]."""
        a = rotation_matrix(p)[:, 2] * (jnp.sum(u, axis=0) / mass)
        return jnp.concatenate([a[:2], a[2:] - _GRAVITY])

    def step(x: dict, u: Array, h: Any) -> dict:
        parts = {name: x[name] for name in ("p", "omega", "offset")}
        after = turning.function(parts, u, h)
        a0, a1 = lifted(x["p"], u), lifted(after["p"], u)
        # the acceleration is taken as linear over the step
        r = x["r"] + arm(x["p"], x["offset"]) + h * x["v"] + h**2 / 6 * (2 * a0 + a1)
        r = r - arm(after["p"], x["offset"])
        return {**after, "r": r, "v": x["v"] + h / 2 * (a0 + a1)}

    def seen(x: dict, u: Array) -> Array:
        return jnp.concatenate([x["omega"], x["r"]])

    names = tuple(f"{what} {axis}" for what in ("gyroscope", "position") for axis in "xyz")
    sensor = Sensor(seen, matrix(R), names=names, stacked=True)
    return StateSpaceModel(
        step, matrix(Q), sensor, space=hover_space(), names=HOVER_NAMES, stacked=True
    )


def controlled(x: dict, loop: Loop, parameters: Parameters = PART_III) -> Float[Array, "4 *s"]:
    """Thrusts of the rotors [N] by the controller for an estimated state.

    The figures of the hover belong to this law, which is not that of `stm.control.FlightController`:
    it only holds the place and gives no moment about the thrust, where that one follows a path with
    a heading and knows the machine as a `System`.
    """
    J = jnp.asarray(parameters.value("inertia"))
    mass, length = parameters.value("mass"), parameters.value("arm")
    R_wb, omega, c = rotation_matrix(x["p"]), x["omega"], x["offset"]
    a = -loop.position * x["r"] - loop.velocity * x["v"]
    a = jnp.concatenate([a[:2], a[2:] + _GRAVITY])
    total = jnp.clip(mass * dot(a, R_wb[:, 2]), 0.0, 4 * loop.thrust)
    wish = apply_transposed(R_wb, a / jnp.sqrt(dot(a, a)))
    # sine of the shortest rotation that brings the rotors' axis to the desired direction
    turn = jnp.stack([-wish[1], wish[0], jnp.zeros_like(total)])
    moment = apply(J.reshape(3, 3, *(1,) * total.ndim), loop.tilt * turn - loop.rate * omega)
    moment = moment + cross(omega, apply(J.reshape(3, 3, *(1,) * total.ndim), omega))
    x_pair = (moment[0] + c[1] * total) / (2 * length)
    y_pair = (moment[1] - c[0] * total) / (2 * length)
    each = jnp.stack([-y_pair, x_pair, y_pair, -x_pair]) + total / 4
    return jnp.clip(each, 0.0, loop.thrust)


def hover_filter(
    tuning: TuningName, loop: Loop, *, moves: bool, parameters: Parameters = PART_III
) -> tuple[StateSpaceModel, Gaussian]:
    """Model and prior of the filter; the tuning applies to rates and offset only."""
    if tuning not in ("report", "consistent"):
        raise SettingError(f"The tunings are report and consistent, not '{tuning}'.")
    value = parameters.value
    own = tuning == "consistent"
    Q = np.array(value("true.Q" if own else "filter.Q"), dtype=float)
    if own and moves:
        Q[6:] = FOLLOWING
    R = value("true.R" if own else "filter.R")
    model = hover_model(
        [*Q, *[0.0] * 3, *[loop.velocity_noise**2] * 3],
        [*R, *[loop.position_noise**2] * 3],
        parameters=parameters,
    )
    start = np.array(value("filter.start"))
    mean = {
        "p": jnp.array([1.0, 0.0, 0.0, 0.0]),
        "omega": jnp.asarray(start[3:6]),
        "offset": jnp.asarray(start[6:]),
        "r": jnp.zeros(3),
        "v": jnp.zeros(3),
    }
    known = np.array(value("filter.P0"))[3:]
    if own:
        known = np.array([WIDE["rate"]] * 3 + [WIDE["offset"]] * 2) ** 2
    rest = [loop.position_noise**2] * 3 + [loop.initial_velocity**2] * 3
    return model, gaussian(mean, np.diag([*[loop.initial_tilt**2] * 3, *known, *rest]))


def simulate_hover(
    case: int = 1,
    tuning: TuningName = "consistent",
    *,
    seeds: int = 50,
    t1: float = 2.0,
    seed: int = 0,
    loop: Loop | None = None,
    parameters: Parameters = PART_III,
) -> Hover:
    """Simulate a hover with thrusts from the estimate, and the centre of mass of a case.

    Args:
        case: number of the case: 1 to 4 have a fixed centre of mass, 5 to 8 a moving one (all the
            same here).
        tuning: "report" or "consistent"; with either, the filter starts level, at the report's
            wrong rates and offset.
        seeds, t1, seed: number of runs, final time [s] and first seed, as in `simulate_case`.

    Raises:
        SettingError: a case that is not 1 to 8, no seeds, or an end before the first step.
    """
    dt = float(parameters.value("step"))
    if case not in range(1, 9) or seeds < 1 or not dt <= t1 < 1e4:
        raise SettingError(
            "A hover needs a case from 1 to 8, at least one seed, and an end between one step of "
            f"{dt:g} s and 1e4 s, not case {case}, {seeds} seeds, {t1:g} s."
        )
    check_seeds(seeds, seed)
    check_room(seeds, t1 / dt)
    loop = Loop() if loop is None else loop
    model, prior = hover_filter(tuning, loop, moves=case > 4, parameters=parameters)
    t = jnp.asarray(dt * np.arange(round(t1 / dt) + 1))
    keys = jax.vmap(jax.random.key)(jnp.arange(seed, seed + seeds))
    fly = lambda t, keys: _flown(model, prior, loop, case > 4, t, keys, parameters)
    return Hover(t, *outer_jit(fly)(t, keys))


def _flown(
    model: StateSpaceModel,
    prior: Gaussian,
    loop: Loop,
    moves: bool,
    t: Array,
    keys: Array,
    parameters: Parameters,
) -> tuple:
    s, count = keys.shape[0], t.shape[0] - 1
    draw = lambda salt, *shape: jnp.moveaxis(
        jax.vmap(lambda key: jax.random.normal(jax.random.fold_in(key, salt), shape))(keys), 0, -1
    )
    value = lambda name: jnp.asarray(parameters.value(name))
    spread = jnp.concatenate(
        [jnp.sqrt(value("true.Q")), jnp.zeros(3), jnp.full(3, loop.velocity_noise)]
    )
    noise = jnp.concatenate([jnp.sqrt(value("true.R")), jnp.full(3, loop.position_noise)])
    kicks, noises = draw(0, count, 14) * spread[:, None], draw(1, count, 6) * noise[:, None]
    dt, case = t[1] - t[0], 5 if moves else 1
    place = lambda now: offsets(case, now)[:, None]
    first = draw(2, 9)
    start = {
        "p": from_rotation_vector(loop.initial_tilt * first[:3]),
        "omega": jnp.broadcast_to(value("true.start")[3:6, None], (3, s)),
        "offset": jnp.broadcast_to(place(t[0]), (2, s)),
        "r": loop.position_noise * first[3:6],
        "v": loop.initial_velocity * first[6:],
    }
    wide = jax.tree.map(lambda a: jnp.broadcast_to(a[..., None], (*a.shape, s)), prior)

    def step(carry: tuple, now: tuple) -> tuple:
        truth, estimate, running = carry
        t0, kick, noise = now
        u = controlled(estimate.mean, loop, parameters)
        drift = (place(t0 + dt) - place(t0)) / loop.substeps
        for _ in range(loop.substeps):
            # half of the load's motion before, and half after each substep
            truth = _shifted(truth, drift / 2)
            truth = model.function(truth, u, dt / loop.substeps)
            truth = _shifted(truth, drift / 2)
        truth = model.space.retract(truth, kick)
        y = model.sensor(truth, u) + noise
        after, seen = DEFAULT.step(model, estimate, y, u, dt)
        ok = running & is_finite(after)
        kept = jax.tree.map(lambda new, old: jnp.where(ok, new, old), after, estimate)
        return (truth, kept, ok), _seen(truth, kept, u, seen, ok, model)

    begin = (start, wide, jnp.ones(s, bool))
    return jax.lax.scan(step, begin, (t[:-1], kicks, noises))[1]


def _shifted(x: dict, d: Array) -> dict:
    """Points after a load has moved the centre of mass by d (2, 1) in the frame, which recoils."""
    offset = x["offset"] + d
    r = x["r"] - arm(x["p"], jnp.broadcast_to(d, offset.shape))
    return {**x, "offset": offset, "r": r}


def _seen(
    truth: dict, estimate: Gaussian, u: Array, seen: Innovation, ok: Array, model: StateSpaceModel
) -> tuple:
    """Results of a step, in the order of `Hover`."""
    pick = lambda x: jnp.concatenate([x["omega"], x["offset"]])
    compare = lambda only: nees(estimate.mean, estimate.factor, truth, model.space, only=only)
    axis = rotation_matrix(truth["p"])[2, 2]
    return (
        u, pick(truth), pick(estimate.mean), estimate.standard_deviation[3:8], truth["r"],
        jnp.arccos(jnp.clip(axis, -1.0, 1.0)), compare(None), compare(slice(6, 8)),
        jnp.where(ok, seen.nis, jnp.inf), ok, seen.normalised, seen.measured,
    )  # fmt: skip
