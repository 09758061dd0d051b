"""Predefined studies: the report's cases from disturbed starts, hover with tolerances, estimation.

A study's plain data have the form of its TOML file; docs/studies.md describes the entries.
"""

from typing import Any

from ..checks.errors import SettingError, nearest_names
from ..uav.airframe import PART_II


def _normal_factor(deviation: float, **more: Any) -> dict[str, Any]:
    return {"distribution": "normal", "mean": 0.0, "standard_deviation": deviation} | more


def _share_factor(deviation: float) -> dict[str, Any]:
    return {
        "distribution": "truncated_normal", "mean": 1.0, "standard_deviation": deviation,
        "low": 1.0 - 4 * deviation, "high": 1.0 + 4 * deviation, "relative": True,
    }  # fmt: skip


def _start_factors(spread: float) -> dict[str, Any]:
    """Factors for posture and rates about the tables' values, with panel angles within reach."""
    around = lambda middle: {
        "distribution": "uniform", "low": middle - spread, "high": middle + spread,
    }  # fmt: skip
    return {
        "start.phi": around(PART_II.value("posture.phi")),
        "start.theta": around(PART_II.value("posture.theta")),
        "start.phi_rate": _normal_factor(2 * spread), "start.theta_rate": _normal_factor(2 * spread),
        "start.roll": _normal_factor(spread / 2), "start.pitch": _normal_factor(spread / 2),
        "start.p": _normal_factor(spread), "start.q": _normal_factor(spread), "start.r": _normal_factor(spread),
    }  # fmt: skip


def _make_quantity(signal: str, take: str, **more: Any) -> dict[str, Any]:
    return {"signal": signal, "take": take} | more


_COLLAPSED = {"collapse": _make_quantity("pointing", "when_above", level=0.5)}
_TILT, _DISTANCE = (
    {"tilt": _make_quantity("tilt", "largest")},
    {"distance": _make_quantity("distance", "final")},
)
_POINTING = {"pointing": _make_quantity("pointing", "largest")}
_PATHS = {name: _make_quantity(name, "path") for name in ("phi", "theta")}

_UAV = _COLLAPSED | _TILT | _DISTANCE | _POINTING | {
    "panel_spin": _make_quantity("panel_spin", "largest"),
    "reaction_top": _make_quantity("force.U47", "largest"),
    "energy": _make_quantity("energy", "final"),
} | _PATHS  # fmt: skip

_COLLAPSE = _COLLAPSED | {
    "phi_end": _make_quantity("phi", "final"), "theta_end": _make_quantity("theta", "final"),
    "spin": _make_quantity("panel_spin", "largest"),
} | _TILT | _PATHS  # fmt: skip

_HOVER = {
    "lost": _make_quantity("tilt", "when_above", level=0.0873), "tilt": _make_quantity("tilt", "final"),
} | _DISTANCE | _POINTING | {"tilt_path": _make_quantity("tilt", "path")}  # fmt: skip

_TOLERANCES = {
    "mass.hexacopter_1": _share_factor(0.005),
    "mass.panel_7": _share_factor(0.01),
    "geometry.rods": _share_factor(0.001),
    "geometry.arms": _share_factor(0.001),
    "geometry.panel_com[2]": _normal_factor(2e-4, mean=PART_II.value("geometry.panel_com")[2]),
} | {
    f"input.rotor_{k}": {"distribution": "normal", "mean": 1.0, "standard_deviation": 0.005}
    for k in range(1, 7)
}  # fmt: skip

READY: dict[str, dict[str, Any]] = {
    f"case_{case}": {
        "scene": "uav_tracker", "case": case, "t1": 1.0, "samples": 10_000, "design": "sobol",
        "every": 0.02, "factors": _start_factors(0.1), "quantities": _UAV,
    }
    for case in (1, 2, 3)
}  # fmt: skip
READY["collapse"] = {
    "scene": "uav_tracker", "case": 1, "t1": 0.3, "samples": 10_000, "design": "sobol",
    "every": 0.01, "factors": _start_factors(0.1), "quantities": _COLLAPSE,
    "failure": {"quantity": "collapse"},
}  # fmt: skip
READY["hover"] = {
    "scene": "uav_tracker", "inputs": "trim", "t1": 1.0, "samples": 4096, "design": "sobol",
    "every": 0.02, "factors": _TOLERANCES, "quantities": _HOVER,
    "failure": {"quantity": "lost"},
}  # fmt: skip
READY |= {
    f"estimate_{case}": {"kind": "estimation", "case": case, "samples": 1024}
    for case in range(1, 9)
}


def load_builtin_study(name: str) -> dict[str, Any]:
    """Plain data of a predefined study.

    Raises:
        SettingError: an unknown name.
    """
    if name not in READY:
        raise SettingError(f"There is no built-in study '{name}'.{nearest_names(name, READY)}")
    return {"name": name} | READY[name]
