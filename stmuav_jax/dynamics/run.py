"""The outcome of a simulation, and how accurate it was."""

from dataclasses import asdict, dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import ArrayLike

from ..mechanics.joint_motion import JointMotion, joint_motion
from ..mechanics.state import State
from .analysis import Snapshot
from .integrate import Trajectory
from .problem import Method
from .scene import Scene


@dataclass(frozen=True)
class Certificate:
    """How accurate a run was, by what can be checked without another run.

    Attributes:
        result: "successful", or why it stopped. t_end: where [s].
        position_residual: largest over all accepted steps [m].
        velocity_residual: [m/s]. norm_error: of |p|^2 - 1.
        energy_error: largest |T + V - work - initial| [J], and over the largest energy.
        momentum_error, angular_momentum_error: largest change not explained by forces,
            over the largest momentum or impulse; None where a joint names ground.
        smallest_singular_value: of the constraint Jacobian along the saved path; None
            without joints.
        rank, rows: at the start. redundant: joints that own a dependent row.
        accepted_steps, rejected_steps: over the whole run.
        compile_seconds, run_seconds: of the integration. analysis_seconds: of the balances
            and reactions, compilation included.
    """

    result: str
    t_end: float
    position_residual: float
    velocity_residual: float
    norm_error: float
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
    compile_seconds: float
    run_seconds: float
    analysis_seconds: float

    def to_dict(self) -> dict[str, Any]:
        """As plain numbers and strings, for JSON."""
        return asdict(self)


@dataclass(frozen=True)
class Run:
    """A simulated scene: saved states, what was computed of them, and the certificate.

    Attributes:
        scene: what was simulated. method: how.
        trajectory: saved times, states, work, impulse (NumPy arrays).
        snapshot: accelerations, reactions, energies at the saved times.
        certificate: how accurate it was.
        settings: the method in words, kept with the results.
        failure: why the end was not reached, in one paragraph; empty if it was.
    """

    scene: Scene
    method: Method
    trajectory: Trajectory
    snapshot: Snapshot
    certificate: Certificate
    settings: dict[str, Any]
    failure: str = ""

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
