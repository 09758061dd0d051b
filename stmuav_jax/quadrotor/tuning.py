"""Filters for the eight cases, with the report's tuning and with a consistent one.

The report's tuning (Table 2.4.2) starts 0.45 m and 0.6 m from the truth with a standard deviation
of 0.9 mm, has three to seven times too much measurement noise, and a random walk of the centre
of mass of 0.14 mm a step. The consistent tuning starts at the same place with suitable standard
deviations (5 rad/s, 0.5 m, not taken from the truth), has the table's true noise, and, if the load
moves, a model of its motion: a swing of known period and unknown centre, amplitudes and phases.
"""

from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.rotation import product, turn_about
from ..checks.errors import SettingError
from ..estimation.gaussians import Gaussian, gaussian
from ..estimation.model import StateSpaceModel
from ..estimation.sigma import Unscented
from ..estimation.update import DEFAULT, AbstractFilter, GaussianFilter
from ..parameters.table import Parameters
from .attitude import attitude_model
from .extended import extended_model
from .model import (
    OBSERVABLE,
    PART_III,
    Kinematics,
    Propagation,
    matrix,
    observable_model,
    report_model,
    report_prior,
)

Kind = Literal["observable", "report", "printed", "attitude"]
TuningName = Literal["report", "consistent"]

KINDS = ("observable", "report", "printed", "attitude")

# Period of the chosen motion of cases 5 to 8 [s].
PERIOD = 2.0

# Standard deviations of the consistent prior: angles [rad], rates [rad/s], offsets [m], swing [m].
WIDE = {"angle": 1.0, "rate": 5.0, "offset": 0.5, "swing": 0.1}

# Variance per step of a random walk of the offset that follows cases 5 to 8 [m^2], found by
# maximum likelihood (docs/estimation.md), for the models without a swing.
FOLLOWING = 3e-7


class FilterTuning(eqx.Module):
    """Tuning: a filter ready to run.

    Attributes:
        name: name for tables.
        model, prior, method: arguments of `kalman_filter`.
        output_matrix: matrix (5, n) that maps the state's error to that of (Omega, offset).
    """

    name: str = eqx.field(static=True)
    model: StateSpaceModel
    prior: Gaussian
    method: AbstractFilter
    output_matrix: Float[np.ndarray, "5 n"]

    def point(self, mean: Any) -> Float[Array, "5 *s"]:
        """Values of Omega and of the offset in a state."""
        if isinstance(mean, dict):
            return jnp.concatenate([mean["omega"], mean["offset"]])
        return jnp.tensordot(jnp.asarray(self.output_matrix), mean, axes=1)


def report_tuning(
    kind: Kind = "report",
    *,
    parameters: Parameters = PART_III,
) -> FilterTuning:
    """Tuning of Table 2.4.2: prior, Q, R and the rule's alpha, beta, kappa.

    Args:
        kind: "report" for the 8 states with corrected kinematics; "printed" for them as printed;
            "observable" for the 5 observable ones; "attitude" for 8 with the attitude on SO(3),
            whose prior and noise are those of the Euler angles taken as a rotation vector.
    """
    value = parameters.value
    rule = Unscented(value("filter.alpha"), value("filter.beta"), value("filter.kappa"))
    model, seen = _model(kind, value("filter.Q"), value("filter.R"), parameters)
    if kind == "attitude":
        prior = _on_rotations(report_prior(parameters))
    else:
        prior = report_prior(parameters, states=seen.shape[1])
    return FilterTuning("report", model, prior, GaussianFilter(rule), seen)


def consistent_tuning(
    case: int,
    kind: Kind = "observable",
    *,
    parameters: Parameters = PART_III,
) -> FilterTuning:
    """Tuning whose covariances are consistent with the errors; see the module.

    With kind="observable" the model contains the swing of cases 5 to 8; models of other kinds
    follow it by a random walk (`FOLLOWING`), which can lag.
    """
    value = parameters.value
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
        return FilterTuning("consistent", model, prior, DEFAULT, seen)
    if case > 4:
        Q[6:] = FOLLOWING
    model, seen = _model(kind, Q, value("true.R"), parameters)
    deviations = np.array([*[WIDE["angle"]] * 3, *rates, *wide])
    if kind == "observable":
        prior = gaussian(start[OBSERVABLE], np.diag(deviations[OBSERVABLE]) ** 2)
    else:
        prior = gaussian(start, np.diag(deviations) ** 2)
        prior = _on_rotations(prior) if kind == "attitude" else prior
    return FilterTuning("consistent", model, prior, DEFAULT, seen)


def _model(
    kind: Kind, Q: Any, R: Any, parameters: Parameters
) -> tuple[StateSpaceModel, np.ndarray]:
    """Model with a constant centre of mass, and the matrix from its errors to (Omega, offset)."""
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
    """Prior of 8 states with Euler parameters for its angles (roll, pitch, yaw of R_Z R_X R_Y)."""
    phi, theta, psi = (prior.mean[i] for i in range(3))
    p = product(turn_about(psi, 2), product(turn_about(phi, 0), turn_about(theta, 1)))
    return Gaussian({"p": p, "omega": prior.mean[3:6], "offset": prior.mean[6:]}, prior.factor)
