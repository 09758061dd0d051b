"""The outcome of a simulation, and what it says of itself."""

from dataclasses import asdict, dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import ArrayLike

from ..mechanics.errors import SettingError
from ..mechanics.joint_motion import JointMotion, joint_motion
from ..mechanics.state import State
from .accuracy import ErrorEstimate
from .analysis import Snapshot
from .integrate import Trajectory
from .problem import Method
from .scene import Scene


@dataclass(frozen=True)
class Seconds:
    """Time spent: compiling, the run, the second run for its error, checks and balances [s]."""

    compile: float
    run: float
    estimate: float
    analysis: float = 0.0


@dataclass(frozen=True)
class Certificate:
    """What a run can say of itself: its estimated error, constraint violation, balances, effort.

    How accurate the motion is say the estimated errors alone. Constraints and balances can hold to
    round-off in a run that is wrong by a centimetre. None stands for what was not found.

    Attributes:
        result: "successful", or why it stopped. t_end: where [s].
        position_error, angle_error, velocity_error, angular_velocity_error: estimated distance from
            the exact motion, the largest over all bodies and saved times [m], [rad], [m/s], [rad/s];
            see `ErrorEstimate`.
        position_error_end, angle_error_end: the largest over all bodies at the last saved time.
        error_e_folding, error_lost_at: of `ErrorEstimate` [s]. error_words: the same in words.
        position_violation: largest residual of constraints that are lengths, over all accepted
            steps [m]. angle_violation: of those that are cosines or angles [rad].
        velocity_violation, angular_velocity_violation: of their rates [m/s], [rad/s].
        norm_violation: of |p|^2 - 1.
        energy_error: largest |T + V - work - initial| [J], and over the largest energy.
        momentum_error, angular_momentum_error: largest change not explained by forces,
            over the largest momentum or impulse; None where a joint names ground.
        smallest_singular_value: of the constraint Jacobian along the saved path; None
            without joints.
        rank, rows: at the start. redundant: joints that own a dependent row.
        accepted_steps, rejected_steps: over the whole run. unsteered_steps: accepted with an error
            so far below the tolerance that the next step could grow as much as a step may.
        compile_seconds, run_seconds: of the integration. estimate_seconds: of the second run.
            analysis_seconds: of the balances and reactions, compilation included.
    """

    result: str
    t_end: float
    position_error: float
    position_error_end: float
    angle_error: float
    angle_error_end: float
    velocity_error: float
    angular_velocity_error: float
    error_e_folding: float | None
    error_lost_at: float | None
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
    accepted_steps: int
    rejected_steps: int
    unsteered_steps: int
    compile_seconds: float
    run_seconds: float
    estimate_seconds: float
    analysis_seconds: float

    def to_dict(self) -> dict[str, Any]:
        """As plain numbers and strings, for JSON; None for what is not a number."""
        return {k: None if v != v else v for k, v in asdict(self).items()}


@dataclass(frozen=True)
class Run:
    """A simulated scene: saved states, what was computed of them, and the certificate.

    Attributes:
        scene: what was simulated. method: how.
        trajectory: saved times, states, work, impulse (NumPy arrays).
        analysis: accelerations, reactions, energies at the saved times, unless left out.
        errors: estimated error at the saved times.
        certificate: what it says of itself.
        settings: the method in words, kept with the results.
        failure: why the end was not reached, in one paragraph; empty if it was.
    """

    scene: Scene
    method: Method
    trajectory: Trajectory
    analysis: Snapshot | None
    errors: ErrorEstimate
    certificate: Certificate
    settings: dict[str, Any]
    failure: str = ""

    @property
    def snapshot(self) -> Snapshot:
        """The analysis; raises `SettingError` if it was left out."""
        if self.analysis is None:
            raise SettingError(
                "This run was made with analysis=False and has no accelerations, reactions or energies."
            )
        return self.analysis

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
        """Whether the end of the span, or an event, was reached."""
        return self.certificate.result in ("successful", "event occurred")

    def body(self, name: str) -> State:
        """The saved states of one body, arrays (k, .)."""
        k = self.scene.system.index(name)
        return jax.tree.map(lambda x: np.asarray(x)[:, k], self.states)

    def joint(self, name: str) -> JointMotion:
        """Coordinates and rates of one joint at the saved times, angles counted on: `.angle`,
        `.shift`, or `.coordinates` (k, c)."""
        found = joint_motion(self.scene.system, self.states, name, self.ts)
        return jax.tree.map(np.asarray, found)


def relative(error: ArrayLike, *scales: ArrayLike) -> float:
    """Largest |error| over the largest of |scales|; zero for a system that does nothing."""
    size = max((float(np.max(np.abs(np.asarray(s)))) for s in scales), default=0.0)
    worst = float(np.max(np.abs(np.asarray(error))))
    return worst / size if size > 0 else worst
