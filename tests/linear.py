"""A random linear-Gaussian system, and the textbook Kalman filter and smoother in NumPy."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from stmuav_jax.estimation.gaussians import gaussian
from stmuav_jax.estimation.model import Sensor, StateSpaceModel


class Product(eqx.Module):
    """A function A x: cases of one size share their programs."""

    A: jax.Array

    def __call__(self, x, *others):
        return self.A @ x


class Linear(NamedTuple):
    """x' = F x + w, y = H x + v, with full covariances and 200 measurements."""

    F: np.ndarray
    H: np.ndarray
    Q: np.ndarray
    R: np.ndarray
    P0: np.ndarray
    m0: np.ndarray
    y: np.ndarray
    x: np.ndarray

    def model(self):
        F, H = Product(jnp.asarray(self.F)), Product(jnp.asarray(self.H))
        return StateSpaceModel(F, self.Q, Sensor(H, self.R))

    def prior(self):
        return gaussian(self.m0, self.P0)


def covariance(rng, k):
    a = rng.normal(size=(k, k))
    # states of about unit size: what rounding leaves is relative to them
    return 0.02 * (a @ a.T / k + 0.1 * np.eye(k))


def random_linear(seed=3, n=6, m=3, count=200):
    rng = np.random.default_rng(seed)
    F, H = rng.normal(size=(n, n)), rng.normal(size=(m, n))
    F *= 0.95 / np.max(np.abs(np.linalg.eigvals(F)))
    Q, R, P0 = covariance(rng, n), covariance(rng, m), covariance(rng, n)
    m0 = 0.3 * rng.normal(size=n)
    x, xs, ys = rng.multivariate_normal(m0, P0), [], []
    for _ in range(count):
        x = F @ x + rng.multivariate_normal(np.zeros(n), Q)
        xs.append(x)
        ys.append(H @ x + rng.multivariate_normal(np.zeros(m), R))
    return Linear(F, H, Q, R, P0, m0, np.array(ys), np.array(xs))


def textbook(case, y=None):
    """Means, covariances, log-likelihood and NIS by the Joseph form; NaN rows are left out."""
    m, P, n = case.m0, case.P0, len(case.m0)
    means, covariances, likelihood, nis = [], [], 0.0, []
    for measured in case.y if y is None else y:
        m, P = case.F @ m, case.F @ P @ case.F.T + case.Q
        there = ~np.isnan(measured)
        H, R, nu = case.H[there], case.R[np.ix_(there, there)], (measured - case.H @ m)[there]
        S = H @ P @ H.T + R
        K = P @ H.T @ np.linalg.inv(S)
        m = m + K @ nu
        left = np.eye(n) - K @ H
        P = left @ P @ left.T + K @ R @ K.T
        nis.append(nu @ np.linalg.solve(S, nu))
        likelihood -= 0.5 * (nis[-1] + np.linalg.slogdet(2 * np.pi * S)[1] if there.any() else 0.0)
        means.append(m)
        covariances.append(P)
    return np.array(means), np.array(covariances), likelihood, np.array(nis)


def textbook_smoother(case, means, covariances):
    """Rauch-Tung-Striebel."""
    m, P = [means[-1]], [covariances[-1]]
    for k in range(len(means) - 2, -1, -1):
        ahead = case.F @ covariances[k] @ case.F.T + case.Q
        G = covariances[k] @ case.F.T @ np.linalg.inv(ahead)
        m.insert(0, means[k] + G @ (m[0] - case.F @ means[k]))
        P.insert(0, covariances[k] + G @ (P[0] - ahead) @ G.T)
    return np.array(m), np.array(P)
