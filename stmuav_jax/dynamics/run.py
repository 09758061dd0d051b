"""Outcome of a simulation, with its certificate."""

import functools
from dataclasses import asdict, dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import ArrayLike

from ..checks.errors import SettingError
from ..mechanics.joint_states import JointMotion, joint_motion
from ..mechanics.state import State
from .error_estimate import ErrorEstimate
from .evaluation import Saved, Snapshot, snapshots
from .formulations.base import AbstractModel
from .integration.advance import Trajectory
from .method import Method
from .scene import Scene


@dataclass(frozen=True)
class Seconds:
    """Times [s] of compilation, the run, the second run of the error estimate, and the analysis."""

    compile: float
    run: float
    estimate: float
    analysis: float = 0.0


@dataclass(frozen=True)
class Certificate:
    """Quality of a run: its estimated error, constraint violations, balances and effort.

    The estimated errors alone tell how accurate the motion is. Constraints and balances can hold to
    round-off in a run that is wrong by a centimetre. None stands for a value that was not computed.

    Attributes:
        result: "successful", or the reason for the stop. t_end: last time reached [s].
        position_error, angle_error, velocity_error, angular_velocity_error: estimated distance from
            the exact motion, the largest over all bodies and saved times [m], [rad], [m/s],
            [rad/s]; see `ErrorEstimate`.
        position_error_end, angle_error_end: the largest over all bodies at the last saved time.
        error_e_folding_time, predictability_horizon: those of `ErrorEstimate` [s]. error_words: both
            in words, and that the start was a singular posture, if the motion has left one.
        position_violation, angle_violation: largest residual of constraints that are lengths [m],
            and of those that are cosines or angles [rad], over all accepted steps.
        velocity_violation, angular_velocity_violation: those of their rates [m/s], [rad/s].
        norm_violation: largest | |p|^2 - 1 |.
        energy_error, relative_energy_error: largest |T + V - work - initial| [J], and its ratio to
            the largest energy.
        momentum_error, angular_momentum_error: largest change not explained by forces,
            relative to the largest momentum or impulse; None where a joint names ground.
        smallest_singular_value: that of the constraint Jacobian along the saved path, at most
            `SEEN` of its states unless the certificate is "full"; None without joints.
        rank, rows: those at the start. redundant: joints that own a dependent row.
        formulation_difference: largest difference between the accelerations by the formulation in
            use and by another, `Augmented` or `Tree`, at any saved time, relative to the largest
            acceleration; None unless the certificate is "full".
        accepted_steps, rejected_steps: numbers over the whole run. steps_at_growth_limit: steps
            accepted with an error so far below the tolerance that the next step could grow as
            much as any may.
        compile_seconds, run_seconds: times of the integration. estimate_seconds: that of the second
            run. analysis_seconds: that of checks and balances, compilation included.
    """

    result: str
    t_end: float
    position_error: float
    position_error_end: float
    angle_error: float
    angle_error_end: float
    velocity_error: float
    angular_velocity_error: float
    error_e_folding_time: float | None
    predictability_horizon: float | None
    error_words: str
    position_violation: float
    angle_violation: float
    velocity_violation: float
    angular_velocity_violation: float
    norm_violation: float
    energy_error: float
    relative_energy_error: float
    momentum_error: float | None
    angular_momentum_error: float | None
    smallest_singular_value: float | None
    rows: int
    rank: int
    redundant: tuple[str, ...]
    formulation_difference: float | None
    accepted_steps: int
    rejected_steps: int
    steps_at_growth_limit: int
    compile_seconds: float
    run_seconds: float
    estimate_seconds: float
    analysis_seconds: float

    def to_dict(self) -> dict[str, Any]:
        """Certificate as plain numbers and strings, for JSON; NaN becomes None."""
        return {k: None if v != v else v for k, v in asdict(self).items()}


@dataclass(frozen=True)
class Run:
    """Simulated scene: its saved states, their analysis, and the certificate.

    Attributes:
        scene: simulated scene. method: method of the integration.
        trajectory: saved times, states, work, impulse (NumPy arrays).
        model: system prepared for the method's formulation, for the analysis of the saved states;
            None if it was left out.
        errors: estimated errors at the saved times.
        certificate: summary of the run's quality.
        settings: description of the method in words, kept with the results.
        failure: reason why the end was not reached, in one paragraph; empty if it was.
    """

    scene: Scene
    method: Method
    trajectory: Trajectory
    model: AbstractModel | None
    errors: ErrorEstimate
    certificate: Certificate
    settings: dict[str, Any]
    failure: str = ""

    @functools.cached_property
    def snapshot(self) -> Snapshot:
        """Accelerations, reactions, energies at the saved times, computed when first asked for.

        Raises:
            SettingError: the run was made with analysis=False.
        """
        if self.model is None:
            raise SettingError(
                "This run was made with analysis=False and has no accelerations, reactions or energies."
            )
        return snapshots(self.method.formulation, self.model, saved(self.trajectory))

    @property
    def ts(self) -> np.ndarray:
        """Saved times (k,) [s]."""
        return np.asarray(self.trajectory.ts)

    @property
    def states(self) -> State:
        """Saved states, arrays (k, n, .)."""
        return self.trajectory.states

    @property
    def successful(self) -> bool:
        """True if the end of the span, or an event, was reached."""
        return self.certificate.result in ("successful", "event occurred")

    def body(self, name: str) -> State:
        """Saved states of one body, arrays (k, .)."""
        k = self.scene.system.index(name)
        return jax.tree.map(lambda x: np.asarray(x)[:, k], self.states)

    def joint(self, name: str) -> JointMotion:
        """Coordinates and rates of one joint at the saved times, with continuous angles: `.angle`,
        `.displacement`, or `.coordinates` (k, c)."""
        found = joint_motion(self.scene.system, self.states, name, self.ts)
        return jax.tree.map(np.asarray, found)


def saved(trajectory: Trajectory) -> Saved:
    """Saved times, states and actuator states of a trajectory."""
    return Saved(np.asarray(trajectory.ts), trajectory.states, np.asarray(trajectory.internal))


def relative(error: ArrayLike, *scales: ArrayLike) -> float:
    """Largest |error| over the largest of |scales|, or the error itself if all scales are zero."""
    size = max((float(np.max(np.abs(np.asarray(s)))) for s in scales), default=0.0)
    worst = float(np.max(np.abs(np.asarray(error))))
    return worst / size if size > 0 else worst
