"""Twin of the allocation: all 3^k sets of rotors at their limits, one after the other, in NumPy."""

import itertools

import numpy as np

FEASIBLE = 1e-9  # of the span: a wrench missed, or a limit passed, by less counts as kept


def least_squares(B, wrenches, low, high, preferred=0.0):
    """The u (n, k) nearest to the preferred ones that give the wrenches; NaN where none does."""
    count = B.shape[1]
    sets = np.array(list(itertools.product((-1, 0, 1), repeat=count)))
    span = high**2 - low**2
    W = 1 / (np.abs(B).sum(axis=1) * span)
    A, x0 = W[:, None] * B * span, (preferred - low**2) / span
    inverses = np.linalg.pinv(A * (sets == 0)[:, None, :], rcond=FEASIBLE)
    held = np.where(sets > 0, 1.0, np.where(sets < 0, 0.0, x0))
    found = np.full((len(wrenches), count), np.nan)
    for k, wrench in enumerate(wrenches):
        b = W * (wrench - low**2 * B.sum(axis=1))
        x = held + np.einsum("sij,sj->si", inverses, b - held @ A.T)
        kept = np.max(np.abs(x @ A.T - b), axis=1) < FEASIBLE
        kept &= (np.min(x, axis=1) > -FEASIBLE) & (np.max(x, axis=1) < 1 + FEASIBLE)
        if np.any(kept):
            found[k] = x[np.argmin(np.where(kept, np.linalg.norm(x - x0, axis=1), np.inf))]
    return low**2 + span * found
