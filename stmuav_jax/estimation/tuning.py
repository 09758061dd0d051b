"""Filters for the eight cases: with the report's tuning, and with one that says what is known.

The report's (Table 2.4.2) starts 0.45 m and 0.6 m from the truth with a stated deviation of
0.9 mm, has three to seven times too much measurement noise, and lets the centre of mass wander
by 0.14 mm a step. The consistent one starts at the same place with the deviations that such a
start has (5 rad/s, 0.5 m, none taken from the truth), has the table's true noise, and, where
the load moves, a model that contains the motion: a swing of known period, unknown otherwise.
"""

from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.rotation import product
from ..mechanics.errors import SettingError
from ..vehicle.parameters import Parameters
from ..vehicle.placement import turn_about
from .attitude import attitude_model
from .extended import extended_model
from .gaussian import Gaussian, gaussian
from .model import StateSpaceModel
from .quadrotor import (
    OBSERVABLE,
    PART_III,
    Kinematics,
    Propagation,
    matrix,
    observable_model,
    report_model,
    report_prior,
)
from .sigma import AbstractRule, Cubature, Unscented
from .update import Form

Kind = Literal["observable", "report", "printed", "attitude"]
TuningName = Literal["report", "consistent"]

KINDS = ("observable", "report", "printed", "attitude")
TUNINGS = ("report", "consistent")

# Period of the chosen motion of cases 5 to 8 [s].
PERIOD = 2.0

# Deviations of the consistent start: angles [rad], rates [rad/s], offsets [m], swing [m].
WIDE = {"angle": 1.0, "rate": 5.0, "offset": 0.5, "swing": 0.1}

# Per-step variance of the offset that lets a random walk follow cases 5 to 8 [m^2], found by
# likelihood (docs/estimation.md); for the models that have no swing.
FOLLOWING = 3e-7


class Tuning(eqx.Module):
    """A filter ready to run.

    Attributes:
        name: for tables. model, prior, rule, form: as `kalman_filter` takes them.
        seen: (5, n), takes the state's error to that of (Omega, offset).
    """

    name: str = eqx.field(static=True)
    model: StateSpaceModel
    prior: Gaussian
    rule: AbstractRule
    form: Form = eqx.field(static=True)
    seen: Float[np.ndarray, "5 n"]

    def point(self, mean: Any) -> Float[Array, "5 *s"]:
        """Omega and the offset of a state."""
        if isinstance(mean, dict):
            return jnp.concatenate([mean["omega"], mean["offset"]])
        return jnp.tensordot(jnp.asarray(self.seen), mean, axes=1)


def report_tuning(
    kind: Kind = "report",
    *,
    rule: AbstractRule | None = None,
    form: Form = "square_root",
    parameters: Parameters = PART_III,
) -> Tuning:
    """Table 2.4.2: prior, Q, R and the rule's alpha, beta, kappa.

    Args:
        kind: "report", 8 states as corrected; "printed" as printed; "observable", the 5 of them
            that can be seen; "attitude", 8 with the attitude on SO(3), its prior and noise
            those of the Euler angles taken as a rotation vector.
    """
    value = parameters.value
    if rule is None:
        rule = Unscented(value("filter.alpha"), value("filter.beta"), value("filter.kappa"))
    model, seen = _model(kind, value("filter.Q"), value("filter.R"), parameters)
    if kind == "attitude":
        prior = _on_rotations(report_prior(parameters))
    else:
        prior = report_prior(parameters, states=seen.shape[1])
    return Tuning("report", model, prior, rule, form, seen)


def consistent_tuning(
    case: int,
    kind: Kind = "observable",
    *,
    rule: AbstractRule | None = None,
    form: Form = "square_root",
    parameters: Parameters = PART_III,
) -> Tuning:
    """A filter whose covariances say what is known; see the module.

    With kind="observable" the swing of cases 5 to 8 is in the model; the others follow it by a
    random walk (`FOLLOWING`), which can lag.
    """
    value = parameters.value
    rule = Cubature() if rule is None else rule
    Q, start = np.array(value("true.Q"), dtype=float), np.array(value("filter.start"))
    rates, wide = [WIDE["rate"]] * 3, [WIDE["offset"]] * 2
    if kind == "observable" and case > 4:
        model = extended_model(
            Q=np.concatenate([Q[OBSERVABLE], np.zeros(4)]),
            R=value("true.R"),
            period=PERIOD,
            parameters=parameters,
        )
        mean = np.concatenate([start[OBSERVABLE], np.zeros(4)])
        prior = gaussian(mean, np.diag([*rates, *wide, *[WIDE["swing"]] * 4]) ** 2)
        seen = np.eye(5, 9)
        seen[3, 5] = seen[4, 6] = 1.0
        return Tuning("consistent", model, prior, rule, form, seen)
    if case > 4:
        Q[6:] = FOLLOWING
    model, seen = _model(kind, Q, value("true.R"), parameters)
    deviations = np.array([*[WIDE["angle"]] * 3, *rates, *wide])
    if kind == "observable":
        prior = gaussian(start[OBSERVABLE], np.diag(deviations[OBSERVABLE]) ** 2)
    else:
        prior = gaussian(start, np.diag(deviations) ** 2)
        prior = _on_rotations(prior) if kind == "attitude" else prior
    return Tuning("consistent", model, prior, rule, form, seen)


def _model(
    kind: Kind, Q: Any, R: Any, parameters: Parameters
) -> tuple[StateSpaceModel, np.ndarray]:
    """A model of the constant centre of mass, and where (Omega, offset) is in its errors."""
    Q = np.asarray(Q)
    last = np.eye(5, 8, k=3)
    if kind == "observable":
        return observable_model(Q=Q[OBSERVABLE], R=R, parameters=parameters), np.eye(5)
    if kind == "attitude":
        return attitude_model(Q, R, parameters=parameters), last
    if kind not in KINDS:
        raise SettingError(f"The models are {', '.join(KINDS)}, not '{kind}'.")
    kinematics: Kinematics = "printed" if kind == "printed" else "corrected"
    steps: Propagation = "euler" if kind == "printed" else "rk4"
    return report_model(kinematics, steps, Q=Q, R=matrix(R), parameters=parameters), last


def _on_rotations(prior: Gaussian) -> Gaussian:
    """The 8 states' prior with its angles (roll, pitch, yaw of R_Z R_X R_Y) as Euler parameters."""
    phi, theta, psi = (prior.mean[i] for i in range(3))
    p = product(turn_about(psi, 2), product(turn_about(phi, 0), turn_about(theta, 1)))
    return Gaussian({"p": p, "omega": prior.mean[3:6], "offset": prior.mean[6:]}, prior.factor)
