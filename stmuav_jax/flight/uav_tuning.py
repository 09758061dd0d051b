"""The UAV's inputs tuned: to hold still, and to turn the panel.

`hold` looks for the constant rotor speeds and actuator forces at which a UAV that starts at rest
stays as it is; `slew` for histories of both that turn the panel from one direction to another and
disturb the UAV least. Both are problems of `tune_inputs`; `peaks` says what a solution needs.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.compiler import quick_jit
from ..checks.errors import ModelError, SettingError, concrete
from ..checks.numbers import array_module, as_numpy, floats
from ..checks.shapes import Numbers
from ..dynamics.method import Method
from ..dynamics.trajectory import integrate
from ..mechanics.inputs import Inputs
from ..tracker.kinematics import strokes
from .flight_trim import FlightTrim, hover, trim_flight
from .flyer import Flyer, FlyerPoint, RotorsAndForces
from .tuning import (
    InputTuning,
    Limit,
    TunedMotion,
    check_span,
    departures,
    end_at,
    joint_forces,
    roughness,
    tune_inputs,
)

# What counts as a disturbance of one: 5 cm, 0.05 rad, 0.2 m/s, 0.2 rad/s.
_DISTURBED = {"r": 0.05, "theta": 0.05, "v": 0.2, "omega": 0.2}
# Of the panel's end: angles to 1 mrad, rates to 10 mrad/s.
_END = {"phi": 1e-3, "theta": 1e-3, "phi_rate": 1e-2, "theta_rate": 1e-2}


def at_rest(angles: Numbers) -> FlyerPoint:
    """Level, at the origin, nothing moving, the panel at angles (2,) [rad]."""
    none, level = floats(np.zeros(3)), floats(np.array([1.0, 0.0, 0.0, 0.0]))
    return FlyerPoint(none, level, floats(angles), none, none, floats(np.zeros(2)))


def hold(
    flyer: Flyer,
    angles: Numbers,
    untuned: RotorsAndForces,
    *,
    horizon: float = 0.4,
    segments: int = 1,
    method: Method | None = None,
) -> InputTuning:
    """Constant inputs that keep the UAV level and its panel at angles (2,) [rad], from rest.

    Args:
        untuned: inputs to start with, such as equal speeds and no forces.
        horizon: time over which departures count [s].
        segments: number of segments of multiple shooting.

    Raises:
        SettingError: a horizon that is not positive, or less than one segment.
    """
    start = at_rest(angles)
    if flyer.lagging:
        own: Any = flyer.propulsion
        start = start._replace(internal=own.speeds_of(jnp.asarray(untuned.speed_squared)))
    untuned = as_numpy(untuned)
    xp = array_module(untuned)
    scale = xp.full_like(untuned.speed_squared, xp.mean(untuned.speed_squared))
    return tune_inputs(
        flyer, [departures(flyer, start)], start=start, duration=horizon,
        inputs=_every(flyer), values=xp.concatenate(untuned),
        sizes=xp.append(scale, np.array([5.0, 5.0])), segments=segments, weight=10.0,
        method=method, name=f"hold {horizon:g} s in {segments}",
    )  # fmt: skip


def _every(flyer: Flyer) -> Inputs:
    """All inputs of the UAV: rotors first, then the two actuators."""
    rotors, actuators = flyer.inputs
    return Inputs(rotors.entries + actuators.entries)


@quick_jit
def _departures(
    flyer: Flyer,
    inputs: RotorsAndForces,
    start: FlyerPoint,
    ts: Float[Array, " k"],
    method: Method,
) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
    """Times reached, and the largest turn of base or panel since the start [rad]."""
    run = integrate(flyer.with_inputs(inputs), flyer.to_state(start), ts, method)
    path = jax.vmap(flyer.from_state)(run.states)
    x = jax.vmap(lambda now: flyer.difference(now, start))(path)
    return run.ts, jnp.max(jnp.abs(x[:, 3:8]), axis=1)


def holding_time(
    flyer: Flyer,
    inputs: RotorsAndForces,
    start: FlyerPoint,
    *,
    limit: float = np.radians(5.0),
    max_time: float = 5.0,
    method: Method | None = None,
) -> float:
    """Time for which base and panel stay within `limit` [rad] of their start [s].

    To 5 ms; at most `max_time`.
    """
    # nothing is differentiated here, so that no modes need to bound the steps
    method = Method(rtol=1e-10, atol=1e-12, steps="state") if method is None else method
    ts = np.arange(0.0, max_time + 2.5e-3, 5e-3)
    reached, turned = map(np.asarray, _departures(flyer, inputs, start, floats(ts), method))
    out = ~(turned < limit) | (np.diff(reached, prepend=-1.0) <= 0)
    return float(ts[np.argmax(out)]) if np.any(out) else max_time


class SlewLimits(NamedTuple):
    """Limits of a slew.

    Attributes:
        force: largest force of the actuators either way [N].
        home: strokes from which the sliders' displacements are measured (2,) [m], see `strokes`.
        lower, upper: limits of the displacements (2,) [m].
        reaction: largest force in any joint [N]; None for no limit.
    """

    force: Numbers = np.inf
    home: Numbers = (0.0, 0.0)
    lower: Numbers = (-np.inf, -np.inf)
    upper: Numbers = (np.inf, np.inf)
    reaction: Numbers | None = None


class Peaks(NamedTuple):
    """Peaks of a history of inputs and of the motion that it causes.

    Attributes:
        force: largest force of an actuator [N].
        lower, upper: smallest and largest displacements of the sliders (2,) [m].
        reaction: largest force in a joint [N], or None where it has no limit.
        tilt: largest tilt of the base [rad]. drift: largest distance of the base from its start [m].
        error: error of the panel angles at the end [rad].
    """

    force: Float[Array, ""]
    lower: Float[Array, "2"]
    upper: Float[Array, "2"]
    reaction: Float[Array, ""] | None
    tilt: Float[Array, ""]
    drift: Float[Array, ""]
    error: Float[Array, ""]


class _Within(eqx.Module):
    """Excess over the limits of a slew, in shares of their sizes."""

    flyer: Flyer
    limits: SlewLimits

    def __call__(self, motion: TunedMotion) -> list[Float[Array, "m n"]]:
        limits = self.limits
        forces = jnp.abs(motion.extremes[:, -2:]) / jnp.asarray(limits.force) - 1
        displacement = _displacements(self.flyer, limits, motion.points)
        upper, lower = jnp.asarray(limits.upper), jnp.asarray(limits.lower)
        over = [forces, (displacement - upper) / 0.01, (lower - displacement) / 0.01]
        if limits.reaction is not None:
            over.append(joint_forces(motion) / jnp.asarray(limits.reaction) - 1)
        return over


def _displacements(flyer: Flyer, limits: SlewLimits, path: FlyerPoint) -> Float[Array, "m 2"]:
    """Displacements of the sliders from home along a path [m]."""
    return strokes(flyer.geometry, path.angles.T).T - jnp.asarray(limits.home)


def slew(
    flyer: Flyer,
    before: Numbers,
    after: Numbers,
    duration: float,
    limits: SlewLimits | None = None,
    *,
    knots: int = 8,
    segments: int = 6,
    outputs_per_segment: int = 8,
    method: Method | None = None,
) -> InputTuning:
    """Histories of inputs that turn the panel between angles (2,) [rad] in a duration [s].

    It starts at the trim before, with inputs that go straight to those of the trim after.

    Raises:
        StateError: there is no trim at one of the two. SettingError: too few knots or segments.
        ModelError: limits that the trims break; says which.
    """
    check_span(duration, segments)
    if knots < 4:
        raise SettingError(f"Cubic splines need four knots or more, not {knots}.")
    limits = SlewLimits() if limits is None else limits
    ends = [trim_flight(flyer, hover(angles)) for angles in (before, after)]
    for end, when in zip(ends, ("before", "after"), strict=True):
        _check_inside(flyer, end, limits, when)
    first, last = (np.asarray(angles, float) for angles in (before, after))
    given = [as_numpy(end.inputs) for end in ends]
    force = np.max(np.abs(np.stack([each.forces for each in given])))
    straight = [np.concatenate(each) for each in given]
    share = np.linspace(0.0, 1.0, knots)[:, None]
    start = ends[0].coordinates

    def guess(t: float) -> FlyerPoint:
        s = t / duration
        smooth = 10 * s**3 - 15 * s**4 + 6 * s**5
        rate = (30 * s**2 - 60 * s**3 + 30 * s**4) / duration
        now = start._replace(angles=floats(first + smooth * (last - first)))
        return now._replace(rates=floats(rate * (last - first)))

    base = {f"{name}_{k}": size for name, size in _DISTURBED.items() for k in "xyz"}
    return tune_inputs(
        flyer,
        [
            departures(flyer, start, base),
            end_at(flyer, start._replace(angles=floats(last)), _END),
            # a second difference of a tenth of the scale counts as one
            roughness,
            Limit(_Within(flyer, limits)),
        ],
        start=start, duration=duration, inputs=_every(flyer),
        values=(1 - share) * straight[0] + share * straight[1],
        sizes=np.append(given[0].speed_squared, [force, force]), knots=knots,
        segments=segments, outputs_per_segment=outputs_per_segment, guess=guess, method=method,
        name=f"slew {_words(before)} to {_words(after)} in {duration:g} s, {knots} knots, {segments}",
    )  # fmt: skip


def peaks(tuning: InputTuning, values: Any, samples: int = 200) -> Peaks:
    """Peaks of a solution of `slew`, integrated from its start without gaps."""
    motion: Any = tuning.motion(values, samples)
    disturbed, end, _, kept = tuning.residuals.cost.residuals  # pyright: ignore
    return _peaks(motion, disturbed.point, end.point, kept.excess)


@quick_jit
def _peaks(motion: TunedMotion, start: FlyerPoint, end: FlyerPoint, kept: _Within) -> Peaks:
    path, flyer = motion.points, kept.flyer
    x = jax.vmap(lambda now: flyer.difference(now, start))(path)
    displacement = _displacements(flyer, kept.limits, path)
    size = lambda v: jnp.max(jnp.sqrt(jnp.sum(v**2, axis=1)))
    limited = kept.limits.reaction is not None
    return Peaks(
        force=jnp.max(jnp.abs(motion.extremes[:, -2:])),
        lower=jnp.min(displacement, axis=0),
        upper=jnp.max(displacement, axis=0),
        reaction=jnp.max(joint_forces(motion)) if limited else None,
        tilt=size(x[:, 3:6]),
        drift=size(x[:, :3]),
        error=jnp.max(jnp.abs(path.angles[-1] - end.angles)),
    )


def _words(angles: Any) -> str:
    return "(" + ", ".join(f"{float(a):.6g}" for a in np.asarray(angles)) + ")"


def _check_inside(flyer: Flyer, end: FlightTrim, limits: SlewLimits, when: str) -> None:
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
                f"The displacement of {name} {when} the turn is {1e3 * stroke[k]:.4g} mm, outside its "
                f"limits of {1e3 * lower[k]:.4g} to {1e3 * upper[k]:.4g} mm."
            )
