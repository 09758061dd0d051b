"""Studies as a store gives them: damped oscillators in closed form."""

import json
from typing import Any

import numpy as np
import scipy.stats as st
import xarray as xr

from stmuav_jax.studies.sampling import Sampling

FREQUENCY = {"distribution": "truncated_normal", "mean": 6.0, "standard_deviation": 1.0, "low": 3.0}
PAYLOAD = {"distribution": "choice", "values": [0.0, 0.5, 1.0]}
FACTORS: dict[str, tuple[Any, str, str]] = {
    "angle": (st.norm(0.0, 0.4), "rad", "initial angle"),
    "rate": (st.uniform(-2.0, 4.0), "rad/s", "initial angular velocity about the base's axis"),
    "frequency": (FREQUENCY, "rad/s", "natural frequency"),
    "damping": (st.lognorm(0.5, scale=0.1), "1", "damping ratio"),
    "offset": (st.uniform(-0.01, 0.02), "m", "offset of the centre of mass along x"),
    "payload": (PAYLOAD, "kg", "payload"),
    "gravity": (9.81, "m/s^2", "gravity"),
}
REASONS = {2: "left the region of contact", 3: "step size fell below its limit"}


def study(
    count: int,
    design: str = "random",
    *,
    factors: dict[str, tuple[Any, str, str]] = FACTORS,
    times: int = 81,
    pending: int = 0,
    failing: bool = True,
    **more,
) -> xr.Dataset:
    """A study of `count` samples, the last of them pending; without a time axis if times is 0."""
    sampling = Sampling({name: one[0] for name, one in factors.items()}, 5, design, **more)
    drawn = dict(zip(sampling.names, sampling.draw(0, count).T, strict=True))
    get = lambda name, default: drawn.get(name, np.full(count, default))
    angle, rate = get("angle", 0.1), get("rate", 0.0)
    frequency, damping = get("frequency", 6.0), np.minimum(get("damping", 0.1), 0.9)
    fast = frequency * np.sqrt(1 - damping**2)
    sway = (rate + damping * frequency * angle) / fast
    peak = np.hypot(angle, sway)
    never = peak < 0.5
    status = np.ones(count, dtype=np.int8)
    if failing:
        status[angle**2 + (rate / 4) ** 2 > 0.6] = 2
        status[(frequency > 7.5) & (damping < 0.08)] = 3
    status[count - pending :] = 0
    bad = status != 1
    hide = lambda y: np.where(bad.reshape(-1, *[1] * (y.ndim - 1)), np.nan, y)
    flag = lambda role, unit, words: {"role": role, "units": unit, "long_name": words}
    data: dict[str, tuple] = {
        name: ("sample", drawn[name], flag("input", unit, words))
        for name, (_, unit, words) in factors.items()
    }
    force = (9.81 + np.outer(peak, [4.0, 9.0]) ** 2) * (1 + get("payload", 0.0)[:, None])
    data |= {
        "peak": ("sample", hide(peak), flag("quantity", "rad", "largest angle")),
        "fall": (
            "sample", hide(np.where(never, np.inf, 1 / np.maximum(peak, 0.1))),
            flag("quantity", "s", "time until the tracker touches its lower stop"),
        ),
        "touched": ("sample", (~never & ~bad).astype(np.int8),
                    flag("quantity", "1", "touched its stop")),
        "force": (("sample", "joint"), hide(force), flag("quantity", "N", "largest reaction")),
        "status": ("sample", status, flag("status", "1", "how the sample ended")),
    }  # fmt: skip
    coordinates: dict = {"joint": ["base", "panel"]}
    if times:
        t = np.linspace(0.0, 4.0, times)
        decay = np.exp(-np.outer(damping * frequency, t))
        turn = np.outer(fast, t)
        path = decay * (angle[:, None] * np.cos(turn) + sway[:, None] * np.sin(turn))
        wear = np.cumsum(np.abs(path), axis=1) / times
        both = np.stack([0.1 * wear, 0.3 * wear * angle[:, None] ** 2], axis=-1)
        data["path"] = (("sample", "time"), hide(path), flag("quantity", "rad", "angle"))
        data["wear"] = (("sample", "time", "joint"), hide(both), flag("quantity", "J", "wear"))
        coordinates["time"] = ("time", t, {"units": "s", "long_name": "time"})
    attributes = {
        "identity": json.dumps(
            {"scene": "oscillator", "settings": {"rtol": 1e-6, "solver": "dopri8"},
             "sampling": sampling.plain()}
        ),
        "reasons": json.dumps({str(code): words for code, words in REASONS.items()}),
        "title": "Damped oscillators",
    }  # fmt: skip
    return xr.Dataset(data, coordinates, attributes)
