"""What does not fit is refused by shape, in the user's words; nothing is broadcast."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from stmuav_jax.checks.errors import ModelError, SettingError
from stmuav_jax.estimation.filter import filter_bank, kalman_filter
from stmuav_jax.estimation.gaussians import Gaussian, gaussian
from stmuav_jax.estimation.likelihood import record_likelihood, tune
from stmuav_jax.estimation.model import Sensor, StateSpaceModel
from stmuav_jax.estimation.online import OnlineFilter
from stmuav_jax.estimation.smoother import smooth
from stmuav_jax.uav.quadrotor.model import attitude_model, observable_model, report_prior

NOISE = 0.01 * np.eye(2)
Y = np.tile([1.0, 5.0], (4, 1))
PRIOR = gaussian([0.0, 0.0], np.eye(2))
STAY = lambda x, u, dt: x
ALL = lambda x, u: x


def model(f: Any = STAY, h: Any = ALL, R: Any = NOISE, **more: Any) -> StateSpaceModel:
    return StateSpaceModel(f, NOISE, Sensor(h, R, stacked=more.get("stacked", False)), **more)


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({"h": lambda x, u: x[:1]}, r"h\(x, u\) must return .* shape \(2,.*but .* \(1,"),
        ({"R": [[0.01]]}, r"h\(x, u\) must return .* shape \(1,.*but .* \(2,"),
        ({"f": lambda x, u, dt: x[:1]}, r"f\(x, u, dt\) must return .* \(2,.*but .* \(1,"),
        ({"f": lambda x, u, dt: [x[0], x[1]]}, r"f\(x, u, dt\) must return .*but .* a list"),
        ({"f": lambda x, u, dt: x + u[0]}, r"f\(x, u, dt\) failed.*No inputs were given"),
        ({"h": lambda x, u: x.astype(jnp.float32)}, r"h\(x, u\) returned float32"),
    ],
)
def test_functions_of_the_wrong_size(parts, words):
    """In the filter; none of them is broadcast."""
    y = Y[:, :1] if "R" in parts else Y
    for stacked in (False, True):
        with pytest.raises((ModelError, SettingError), match=words):
            kalman_filter(model(**parts, stacked=stacked), PRIOR, y, dt=1.0)


def test_every_entry_checks():
    """The online filter, the bank, the likelihood, the search and the smoother as well."""
    wrong = model(h=lambda x, u: x[:1])
    words = r"h\(x, u\) must return"
    with pytest.raises(ModelError, match=words):
        OnlineFilter(wrong, PRIOR).step(Y[0], t=1.0)
    with pytest.raises(ModelError, match=words):
        filter_bank(wrong, PRIOR, jnp.asarray(Y[:, :, None]), dt=1.0)
    with pytest.raises(ModelError, match=words):
        record_likelihood(lambda v: wrong, {}, PRIOR, jnp.asarray(Y), dt=1.0)
    with pytest.raises(ModelError, match=words):
        tune(lambda v: wrong, {"R": np.ones(2)}, PRIOR, jnp.asarray(Y), dt=1.0)
    found = kalman_filter(model(), PRIOR, Y, dt=1.0)
    with pytest.raises(ModelError, match=r"f\(x, u, dt\) must return"):
        smooth(model(f=lambda x, u, dt: x[:1]), found)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"y": Y[:, 0]}, r"shape \(T, 2\), but it is \(4,\)"),
        ({"y": Y[:0]}, "no measurements"),
        ({"dt": np.nan}, "dt must be finite"),
        ({"u": np.zeros((4, 1, 3))}, r"Inputs must have shape \(T, k\)"),
        ({"y": jnp.asarray(Y, jnp.float32)}, "float32"),
        ({"prior": Gaussian(jnp.array([jnp.nan, 0.0]), jnp.eye(2))}, "must be finite"),
        ({"prior": gaussian(np.zeros(5), np.eye(5))}, "5 x 5"),
        ({"dt": -0.1}, "must be positive"),
        ({"dt": None}, "either dt"),
    ],
)
def test_records(given, words):
    more: dict[str, Any] = {"prior": PRIOR, "y": Y, "dt": 1.0} | given
    prior, y = more.pop("prior"), more.pop("y")
    with pytest.raises((ModelError, SettingError), match=words):
        kalman_filter(model(), prior, y, **more)


def test_banks():
    """Stack axes of prior, measurements, inputs and covariances agree, or are not there."""
    priors = jax.tree.map(lambda a: jnp.repeat(a[..., None], 3, -1), PRIOR)
    y = np.repeat(Y[..., None], 3, -1)
    with pytest.raises(ModelError, match=r"shape \(T, 2, 3\)"):
        kalman_filter(model(), priors, y[..., :2], dt=1.0)
    with pytest.raises(ModelError, match="Inputs"):
        kalman_filter(model(), priors, y, u=np.zeros((4, 1, 2)), dt=1.0)
    many = model(R=np.repeat(NOISE[..., None], 4, -1))
    with pytest.raises(ModelError, match="R has stack axes"):
        kalman_filter(many, priors, y, dt=1.0)


def test_points():
    """A mean that is not finite, a quaternion that is not unit, thrusts of another number."""
    with pytest.raises(ModelError, match="must be finite"):
        gaussian([np.nan, 0.0], np.eye(2))
    quad = attitude_model(np.ones(8), np.ones(3))
    mean = {"p": 1.01 * jnp.eye(4)[0], "omega": jnp.zeros(3), "offset": jnp.zeros(2)}
    with pytest.raises(ModelError, match=r"\['p'\] must be unit .* norm is 1.01"):
        kalman_filter(quad, gaussian(mean, np.eye(8)), np.zeros((2, 3)), u=np.ones((2, 4)), dt=1e-3)
    with pytest.raises(ModelError, match="four thrusts"):
        kalman_filter(
            observable_model(),
            report_prior(states=5),
            np.zeros((2, 3)),
            u=np.ones((2, 5)),
            dt=1e-3,
        )
