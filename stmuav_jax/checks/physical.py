"""Checks of masses, inertia tensors and Euler parameters that a user gives."""

import numpy as np

from .errors import ModelError, concrete
from .shapes import Numbers

# Admitted difference of |p| from 1 in user input; beyond it the user has to decide.
UNIT_TOLERANCE = 1e-9


# Relative tolerance of the symmetry and triangle checks, for round-off in rotated tensors.
_ROUND_OFF = 1e-12


# A principal moment below this fraction of the largest one is zero up to round-off.
_SINGULAR = 1e-15


def check_mass(mass: Numbers, what: str) -> None:
    """Raise `ModelError` unless the mass [kg] is finite and positive."""
    if concrete(mass) and not (np.isfinite(mass) and float(mass) > 0):  # pyright: ignore
        raise ModelError(f"The mass of {what} must be finite and positive, but it is {mass} kg.")


def check_inertia(inertia: Numbers, what: str, tolerance: float) -> None:
    """Raise `ModelError` unless a rigid body can have the inertia tensor (3, 3) [kg m^2]."""
    if not concrete(inertia):
        return
    tensor = np.asarray(inertia, dtype=float)
    if not np.all(np.isfinite(tensor)):
        raise ModelError(
            f"The inertia tensor of {what} must be finite, but it is {tensor.tolist()}."
        )
    size = np.abs(tensor).max()
    if np.abs(tensor - tensor.T).max() > _ROUND_OFF * size:
        raise ModelError(
            f"The inertia tensor of {what} must be symmetric, but it is {tensor.tolist()}."
        )
    moments = np.linalg.eigvalsh(tensor)
    listed = ", ".join(f"{m:.6g}" for m in moments)
    if moments[0] <= _SINGULAR * moments[2]:
        raise ModelError(
            f"The inertia tensor of {what} must be positive definite, but its principal moments "
            f"are {listed} kg m^2.{_advice(moments)}"
        )
    excess = moments[2] / (moments[0] + moments[1]) - 1
    if excess > max(tolerance, _ROUND_OFF):
        raise ModelError(
            f"No body has the inertia tensor of {what}: its principal moments {listed} kg m^2 "
            f"break the triangle inequality, the largest exceeds the sum of the other two by "
            f"{100 * excess:.3g} %. Correct the entry, or admit a rounded table by "
            f"triangle_tolerance={excess * 1.01:.2g}."
        )


def _advice(moments: np.ndarray) -> str:
    """Advice for an error message, from principal moments in ascending order [kg m^2]."""
    size = np.abs(moments).max()
    if size == 0:
        return (
            " A point mass has no inertia to turn: give it that of a small sphere, 2 m r^2 / 5 "
            "(stmuav_jax.sphere); where nothing turns it, the value does not matter."
        )
    if abs(moments[0]) <= _SINGULAR * size and moments[1] > _SINGULAR * size:
        return (
            " A rod without thickness has no inertia about its own axis, so that nothing would "
            "resist a turn about it: give it the moment that its thickness gives, m r^2 / 2 for "
            "the radius r (stmuav_jax.cylinder); where joints keep it from that turn, the value does "
            "not matter."
        )
    return ""


def check_unit(p: Numbers, what: str, error: type[Exception]) -> None:
    """Raise `error` unless p (4,) is finite and |p| = 1 within `UNIT_TOLERANCE`."""
    if not concrete(p):
        return
    values = np.asarray(p, dtype=float)
    if not np.all(np.isfinite(values)):
        raise error(
            f"The Euler parameters of {what} must be finite, but they are {values.tolist()}."
        )
    norm = float(np.sqrt(values @ values))
    if abs(norm - 1) <= UNIT_TOLERANCE:
        return
    if norm == 0:
        raise error(f"The Euler parameters of {what} are all zero, which is no rotation at all.")
    raise error(
        f"The Euler parameters of {what} must have norm 1, but {values.tolist()} has norm "
        f"{norm:.6g}. If they are right up to scale, divide them by their norm "
        "(stmuav_jax.normalise); if they were printed with few digits, find the nearest posture "
        "that the joints allow with stmuav_jax.assemble."
    )
