"""Predefined studies: the report's cases from disturbed starts, hover with tolerances, estimation.

A study's plain data have the form of its TOML file; docs/studies.md describes the entries.
"""

from collections.abc import Mapping
from typing import Any

from ..checks.errors import SettingError, nearest_names
from ..checks.schema import shown
from ..parameters.airframe import PART_II
from ..parameters.table import Parameters
from .batch import FlightWork
from .estimates import EstimationStudy, EstimationWork
from .schema import estimation_file
from .study import study_from_plain
from .work import AbstractWork


def _normal(deviation: float, **more: Any) -> dict[str, Any]:
    return {"distribution": "normal", "mean": 0.0, "standard_deviation": deviation} | more


def _share(deviation: float) -> dict[str, Any]:
    return {
        "distribution": "truncated_normal", "mean": 1.0, "standard_deviation": deviation,
        "low": 1.0 - 4 * deviation, "high": 1.0 + 4 * deviation, "relative": True,
    }  # fmt: skip


def _start(spread: float) -> dict[str, Any]:
    """Factors for posture and rates about the tables' values, with panel angles within reach."""
    around = lambda middle: {
        "distribution": "uniform", "low": middle - spread, "high": middle + spread,
    }  # fmt: skip
    return {
        "start.phi": around(PART_II.value("posture.phi")),
        "start.theta": around(PART_II.value("posture.theta")),
        "start.phi_rate": _normal(2 * spread), "start.theta_rate": _normal(2 * spread),
        "start.roll": _normal(spread / 2), "start.pitch": _normal(spread / 2),
        "start.p": _normal(spread), "start.q": _normal(spread), "start.r": _normal(spread),
    }  # fmt: skip


def _seen(signal: str, take: str, **more: Any) -> dict[str, Any]:
    return {"signal": signal, "take": take} | more


_COLLAPSED = {"collapse": _seen("pointing", "when_above", level=0.5)}
_TILT, _DISTANCE = {"tilt": _seen("tilt", "largest")}, {"distance": _seen("distance", "final")}
_POINTING = {"pointing": _seen("pointing", "largest")}
_PATHS = {name: _seen(name, "path") for name in ("phi", "theta")}

_UAV = _COLLAPSED | _TILT | _DISTANCE | _POINTING | {
    "panel_spin": _seen("panel_spin", "largest"),
    "reaction_top": _seen("force.U47", "largest"),
    "energy": _seen("energy", "final"),
} | _PATHS  # fmt: skip

_COLLAPSE = _COLLAPSED | {
    "phi_end": _seen("phi", "final"), "theta_end": _seen("theta", "final"),
    "spin": _seen("panel_spin", "largest"),
} | _TILT | _PATHS  # fmt: skip

_HOVER = {
    "lost": _seen("tilt", "when_above", level=0.0873), "tilt": _seen("tilt", "final"),
} | _DISTANCE | _POINTING | {"tilt_path": _seen("tilt", "path")}  # fmt: skip

_TOLERANCES = {
    "mass.hexacopter_1": _share(0.005),
    "mass.panel_7": _share(0.01),
    "geometry.rods": _share(0.001),
    "geometry.arms": _share(0.001),
    "geometry.panel_com[2]": _normal(2e-4, mean=PART_II.value("geometry.panel_com")[2]),
} | {
    f"input.rotor_{k}": {"distribution": "normal", "mean": 1.0, "standard_deviation": 0.005}
    for k in range(1, 7)
}  # fmt: skip

READY: dict[str, dict[str, Any]] = {
    f"case_{case}": {
        "scene": "uav_tracker", "case": case, "t1": 1.0, "samples": 10_000, "design": "sobol",
        "every": 0.02, "factors": _start(0.1), "quantities": _UAV,
    }
    for case in (1, 2, 3)
}  # fmt: skip
READY["collapse"] = {
    "scene": "uav_tracker", "case": 1, "t1": 0.3, "samples": 10_000, "design": "sobol",
    "every": 0.01, "factors": _start(0.1), "quantities": _COLLAPSE,
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


def ready(name: str) -> dict[str, Any]:
    """Plain data of a predefined study.

    Raises:
        SettingError: an unknown name.
    """
    if name not in READY:
        raise SettingError(f"There is no ready study '{name}'.{nearest_names(name, READY)}")
    return {"name": name} | READY[name]


def make_work(
    plain: Mapping[str, Any], table: Parameters | None = None, **options: Any
) -> AbstractWork:
    """Work of a study from its plain data.

    Args:
        plain: plain data of the study.
        table: parameter table of the scene, where the user has changed some.
        options: options of `FlightWork`.

    Raises:
        SettingError: entries that are unknown, missing or impossible.
    """
    kind = plain.get("kind", "flights")
    if kind == "flights":
        study = study_from_plain(plain, table)
        if options.get("lanes") is None:
            options["lanes"] = plain.get("lanes")
        return FlightWork(study, **options)
    if kind != "estimation":
        raise SettingError(
            f"A study's kind is flights or estimation, or missions with a mission, not {shown(kind)}."
        )
    given = estimation_file(plain)
    if table is not None:
        raise SettingError("Studies of estimation take no other parameters yet.")
    if any(value is not None for value in options.values()):
        names = ", ".join(name for name, value in options.items() if value is not None)
        raise SettingError(f"Studies of estimation have no settings {names}.")
    return EstimationWork(
        EstimationStudy(given.name, given.case, given.tuning, given.t1, given.seed)
    )
