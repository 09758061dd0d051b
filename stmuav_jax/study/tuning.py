"""Inputs tuned by gradients through the flight: to hold still, and to turn the panel.

`hold` looks for the constant rotor speeds and actuator forces at which a UAV that starts at rest
stays as it is; `slew` for histories of both, cubic splines through a few knots, that turn the
panel from one direction to another and disturb the UAV least. Both are least-squares problems
by multiple shooting (`Shooting`), to be solved by `search`.

Limits are kept by residuals that are zero inside; `peaks` says what a solution needs of each.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.compiler import quick_jit
from ..algebra.rotation import to_rotation_vector
from ..algebra.shapes import Numbers
from ..dynamics.integrate import integrate
from ..dynamics.problem import Method
from ..dynamics.reactions import in_joint_axes
from ..dynamics.stabilisation import Unstabilised
from ..dynamics.tree import Tree
from ..mechanics.errors import ModelError, SettingError, check_finite, concrete
from ..mechanics.sampled import Sampled
from ..mechanics.system import System
from ..vehicle.flyer import Coordinates, Flyer, Inputs, displacement
from ..vehicle.kinematics import strokes
from .shooting import Shooting, fly, shooting
from .trim import Trim, hover, trim

# What counts as a disturbance of one: 5 cm, 0.05 rad, 0.2 m/s, 0.2 rad/s.
_POSITION, _TILT, _SPEED, _RATE = 0.05, 0.05, 0.2, 0.2
# Of the panel's end: angles to 1 mrad, rates to 10 mrad/s.
_END_ANGLE, _END_RATE = 1e-3, 1e-2


@dataclass(frozen=True)
class Tuning:
    """A least-squares problem whose values are inputs.

    Attributes:
        name: what it is, for files: a search of one is not a search of another.
        residuals: for `search`. start: the values with which it starts.
    """

    name: str
    residuals: Shooting
    start: Any

    def inputs(self, values: Any) -> Inputs:
        """The inputs that the values of a search stand for."""
        return self.residuals.inputs(values["values"])


def at_rest(angles: Numbers) -> Coordinates:
    """Level, at the origin, nothing moving, the panel at angles (2,) [rad]."""
    none = jnp.zeros(3)
    level = jnp.array([1.0, 0.0, 0.0, 0.0])
    return Coordinates(none, level, jnp.asarray(angles, float), none, none, jnp.zeros(2))


class _Constant(eqx.Module):
    """Inputs from numbers of order one."""

    squared: Float[Array, " k"]
    force: Float[Array, ""]

    def __call__(self, values: Any) -> Inputs:
        return Inputs(values["squared"] * self.squared, values["forces"] * self.force)


def _drift(values: Any, ts: Array, path: Coordinates, system: System, *, start: Coordinates) -> Any:
    del values, system
    return jax.vmap(lambda now: displacement(now, start))(path) / jnp.sqrt(len(ts))


def hold(
    flyer: Flyer,
    angles: Numbers,
    untuned: Inputs,
    *,
    horizon: float = 0.4,
    segments: int = 1,
    method: Method | None = None,
) -> Tuning:
    """Constant inputs that keep the UAV level and its panel at angles (2,) [rad], from rest.

    Args:
        untuned: inputs to start with, such as equal speeds and no forces.
        horizon: over which departures are counted [s]. segments: of multiple shooting.

    Raises:
        SettingError: a horizon that is not positive, or less than one segment.
    """
    _check_span(horizon, segments)
    start = at_rest(angles)
    scale = jnp.full_like(untuned.squared, jnp.mean(untuned.squared))
    inputs = _Constant(scale, jnp.asarray(5.0))
    problem = shooting(
        flyer, inputs, eqx.Partial(_drift, start=start), lambda _: start,
        np.linspace(0.0, horizon, segments + 1), method, weight=10.0,
    )  # fmt: skip
    values = {"squared": untuned.squared / scale, "forces": untuned.forces / 5.0}
    return Tuning(f"hold {horizon:g} s in {segments}", problem, problem.unknowns(values))


@quick_jit
def _departures(
    flyer: Flyer, inputs: Inputs, start: Coordinates, ts: Float[Array, " k"], method: Method
) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
    """Times reached, and the largest turn of base or panel since the start [rad]."""
    run = integrate(flyer.with_inputs(inputs), flyer.state(start), ts, method)
    path = jax.vmap(flyer.coordinates)(run.states)
    x = jax.vmap(lambda now: displacement(now, start))(path)
    return run.ts, jnp.max(jnp.abs(x[:, 3:8]), axis=1)


def holding_time(
    flyer: Flyer,
    inputs: Inputs,
    start: Coordinates,
    *,
    limit: float = np.radians(5.0),
    longest: float = 5.0,
    method: Method | None = None,
) -> float:
    """Until when base and panel stay within `limit` [rad] of where they are at the start [s].

    To 5 ms; at most `longest`.
    """
    method = Method(rtol=1e-10, atol=1e-12) if method is None else method
    ts = jnp.arange(0.0, longest + 2.5e-3, 5e-3)
    reached, turned = map(np.asarray, _departures(flyer, inputs, start, ts, method))
    out = ~(turned < limit) | (np.diff(reached, prepend=-1.0) <= 0)
    return float(ts[np.argmax(out)]) if np.any(out) else longest


class SlewLimits(NamedTuple):
    """What a slew must keep to.

    Attributes:
        force: of the actuators either way [N].
        home: strokes from which the sliders' shifts are measured (2,) [m], see `strokes`.
        lower, upper: of the shifts (2,) [m].
        reaction: of the force in any joint [N], or None: not looked at.
    """

    force: Numbers = np.inf
    home: Numbers = (0.0, 0.0)
    lower: Numbers = (-np.inf, -np.inf)
    upper: Numbers = (np.inf, np.inf)
    reaction: Numbers | None = None


class Peaks(NamedTuple):
    """What a history needs, and how it disturbs.

    Attributes:
        force: largest of an actuator [N]. lower, upper: least and largest shifts (2,) [m].
        reaction: largest force in a joint [N], or None where it has no limit.
        tilt: largest [rad]. drift: largest [m]. error: of the panel at the end [rad].
    """

    force: Float[Array, ""]
    lower: Float[Array, "2"]
    upper: Float[Array, "2"]
    reaction: Float[Array, ""] | None
    tilt: Float[Array, ""]
    drift: Float[Array, ""]
    error: Float[Array, ""]


class _Histories(eqx.Module):
    """Splines through values of order one at the knots."""

    ts: tuple[float, ...] = eqx.field(static=True)
    squared: Float[Array, " k"]
    force: Float[Array, ""]

    def __call__(self, values: Any) -> Inputs:
        ts = np.array(self.ts)
        return Inputs(
            Sampled(ts, values["squared"] * self.squared, 3),
            Sampled(ts, values["forces"] * self.force, 3),
        )


class _Slew(eqx.Module):
    """Residuals of a slew; see `slew`."""

    flyer: Flyer
    inputs: _Histories
    limits: SlewLimits
    start: Coordinates
    target: Float[Array, "2"]

    def __call__(self, values: Any, ts: Array, path: Coordinates, system: System) -> Any:
        x = jax.vmap(lambda now: displacement(now, self.start))(path)
        sizes = [_POSITION] * 3 + [_TILT] * 3 + [_SPEED] * 3 + [_RATE] * 3
        base = jnp.concatenate([x[:, :6], x[:, 8:14]], axis=1) / jnp.array(sizes)
        end = (path.angles[-1] - self.target) / _END_ANGLE, path.rates[-1] / _END_RATE
        share = 1 / jnp.sqrt(len(ts))
        # a second difference of a tenth of the scale counts as one
        rough = {k: jnp.diff(v, 2, axis=0) for k, v in values.items()}
        over = self._beyond(values, ts, path, system)
        return share * base, end, rough, jax.tree.map(lambda r: 100 * share * r, over)

    def _beyond(self, values: Any, ts: Array, path: Coordinates, system: System) -> Any:
        """By how much limits are passed, over their size."""
        forces = jax.vmap(lambda t: self.inputs(values).forces(t))(ts)
        stroke = strokes(self.flyer.geometry, path.angles.T).T - jnp.asarray(self.limits.home)
        lower, upper = jnp.asarray(self.limits.lower), jnp.asarray(self.limits.upper)
        past = lambda x: jnp.maximum(x, 0.0)
        over = [past(jnp.abs(forces) / jnp.asarray(self.limits.force) - 1)]
        over += [past(stroke - upper) / 0.01, past(lower - stroke) / 0.01]
        if self.limits.reaction is not None:
            loads = joint_forces(self.flyer, system, ts, path)
            over.append(past(loads / jnp.asarray(self.limits.reaction) - 1))
        return over


def joint_forces(
    flyer: Flyer, system: System, ts: Float[Array, " k"], path: Coordinates
) -> Float[Array, "k joints"]:
    """Size of the reaction force in every joint along a path [N]."""
    tree = Tree()
    model = tree.prepare(system)

    def at(t: Array, now: Coordinates) -> Array:
        state = flyer.state(now)
        found = tree.accelerations(model, t, state, Unstabilised())
        force = in_joint_axes(system, state, tree.reactions(model, t, state, found)).force
        return jnp.sqrt(jnp.sum(force**2, axis=1))

    return jax.vmap(at)(ts, path)


def slew(
    flyer: Flyer,
    before: Numbers,
    after: Numbers,
    duration: float,
    limits: SlewLimits | None = None,
    *,
    knots: int = 8,
    segments: int = 6,
    inside: int = 8,
    method: Method | None = None,
) -> Tuning:
    """Histories of inputs that turn the panel between angles (2,) [rad] in a duration [s].

    It starts at the trim before, with inputs that go straight to those of the trim after.

    Raises:
        StateError: there is no trim at one of the two. SettingError: too few knots or segments.
        ModelError: limits that the trims break; says which.
    """
    _check_span(duration, segments)
    if knots < 4:
        raise SettingError(f"Cubic splines need four knots or more, not {knots}.")
    limits = SlewLimits() if limits is None else limits
    ends = [trim(flyer, hover(angles)) for angles in (before, after)]
    for end, when in zip(ends, ("before", "after"), strict=True):
        _check_inside(flyer, end, limits, when)
    first, last = (jnp.asarray(angles, float) for angles in (before, after))
    share = np.linspace(0.0, 1.0, knots)[:, None]
    force = jnp.max(jnp.abs(jnp.stack([end.inputs.forces for end in ends])))
    squared = ends[0].inputs.squared
    inputs = _Histories(tuple(float(duration * s) for s in share[:, 0]), squared, force)
    values = {
        "squared": 1 + share * (ends[1].inputs.squared / squared - 1),
        "forces": (1 - share) * ends[0].inputs.forces / force
        + share * ends[1].inputs.forces / force,
    }
    start = ends[0].coordinates

    def guess(t: float) -> Coordinates:
        s = t / duration
        smooth = 10 * s**3 - 15 * s**4 + 6 * s**5
        rate = (30 * s**2 - 60 * s**3 + 30 * s**4) / duration
        now = start._replace(angles=first + smooth * (last - first))
        return now._replace(rates=rate * (last - first))

    cost = _Slew(flyer, inputs, limits, start, last)
    edges = np.linspace(0.0, duration, segments + 1)
    problem = shooting(flyer, inputs, cost, guess, edges, method, inside=inside, weight=1e3)
    name = f"slew {_words(before)} to {_words(after)} in {duration:g} s, {knots} knots, {segments}"
    return Tuning(name, problem, problem.unknowns(values))


def peaks(tuning: Tuning, values: Any, samples: int = 200) -> Peaks:
    """What a solution of `slew` needs and does, flown from its start in one piece."""
    problem = tuning.residuals
    cost = problem.cost
    assert isinstance(cost, _Slew)
    inputs = tuning.inputs(values)
    ts = jnp.linspace(0.0, problem.edges[-1], samples)
    return _peaks(problem.flyer, cost, inputs, ts, problem.method)


@quick_jit
def _peaks(
    flyer: Flyer, cost: _Slew, inputs: Inputs, ts: Float[Array, " k"], method: Method
) -> Peaks:
    system = flyer.with_inputs(inputs)
    path = fly(flyer, system, cost.start, ts, method)
    x = jax.vmap(lambda now: displacement(now, cost.start))(path)
    home = jnp.asarray(cost.limits.home)[:, None]
    shift = strokes(flyer.geometry, path.angles.T) - home
    size = lambda v: jnp.max(jnp.sqrt(jnp.sum(v**2, axis=1)))
    reaction = None
    if cost.limits.reaction is not None:
        reaction = jnp.max(joint_forces(flyer, system, ts, path))
    return Peaks(
        force=jnp.max(jnp.abs(jax.vmap(lambda t: inputs.forces(t))(ts))),
        lower=jnp.min(shift, axis=1),
        upper=jnp.max(shift, axis=1),
        reaction=reaction,
        tilt=size(x[:, 3:6]),
        drift=size(x[:, :3]),
        error=jnp.max(jnp.abs(path.angles[-1] - cost.target)),
    )


def flown(
    tuning: Tuning, values: Any, samples: int = 200
) -> tuple[Float[np.ndarray, " k"], dict[str, dict[str, np.ndarray]]]:
    """Times and curves of a solution of `slew`, by "quantity [unit]" and name, for figures."""
    problem = tuning.residuals
    inputs = tuning.inputs(values)
    ts = jnp.linspace(0.0, problem.edges[-1], samples)
    path, squared, forces = _flown(problem.flyer, problem.start, inputs, ts, problem.method)
    tilt = np.asarray(jax.vmap(to_rotation_vector)(path.p))
    deg = lambda x: np.degrees(np.asarray(x))
    return np.asarray(ts), {
        "panel [degrees]": {"phi": deg(path.angles[:, 0]), "theta": deg(path.angles[:, 1])},
        "UAV [degrees]": {k: deg(tilt[:, i]) for i, k in enumerate(("roll", "pitch", "yaw"))},
        "UAV [mm]": {k: 1e3 * np.asarray(path.r[:, i]) for i, k in enumerate("xyz")},
        "actuators [N]": {f"slider {i + 2}": np.asarray(forces[:, i]) for i in range(2)},
        "rotors [rad/s]": {
            f"{i + 1}": np.sqrt(np.asarray(squared[:, i])) for i in range(squared.shape[1])
        },
    }


@quick_jit
def _flown(
    flyer: Flyer, start: Coordinates, inputs: Inputs, ts: Float[Array, " k"], method: Method
) -> tuple[Coordinates, Float[Array, "k r"], Float[Array, "k 2"]]:
    path = fly(flyer, flyer.with_inputs(inputs), start, ts, method)
    each = lambda f: jax.vmap(lambda t: f(t, None))(ts)
    return path, each(inputs.squared), each(inputs.forces)


def _words(angles: Any) -> str:
    return "(" + ", ".join(f"{float(a):.6g}" for a in np.asarray(angles)) + ")"


def _check_span(span: float, segments: int) -> None:
    check_finite(span, "The time", "s")
    if not span > 0:
        raise SettingError(f"The time must be positive, not {span:g} s.")
    if segments < 1:
        raise SettingError(f"There must be at least one segment, not {segments}.")


def _check_inside(flyer: Flyer, end: Trim, limits: SlewLimits, when: str) -> None:
    """The trim before or after must keep to the limits that do not depend on the motion."""
    force = float(jnp.max(jnp.abs(end.inputs.forces)))
    if concrete(limits.force) and force > float(np.min(limits.force)):
        raise ModelError(
            f"Hovering {when} the turn needs an actuator force of {force:.4g} N, but the limit is "
            f"{float(np.min(limits.force)):.4g} N."
        )
    stroke = np.asarray(strokes(flyer.geometry, end.coordinates.angles)) - np.asarray(limits.home)
    lower, upper = np.asarray(limits.lower, float), np.asarray(limits.upper, float)
    for k, name in enumerate(("slider_2", "slider_3")):
        if not lower[k] <= stroke[k] <= upper[k]:
            raise ModelError(
                f"The shift of {name} {when} the turn is {1e3 * stroke[k]:.4g} mm, outside its "
                f"limits of {1e3 * lower[k]:.4g} to {1e3 * upper[k]:.4g} mm."
            )
