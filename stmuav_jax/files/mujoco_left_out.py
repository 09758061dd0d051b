"""List of what a model of MuJoCo has and a system has not."""

from typing import Any, NamedTuple

import numpy as np

# Largest number of names in one sentence.
_SHOWN = 12
_FREE, _BALL, _HINGE = 0, 1, 3


class LeftOut(NamedTuple):
    """Names of things that were left out, by what they are."""

    names: dict[str, list[str]]

    def add(self, what: str, name: str) -> None:
        """Add one name, or "" for a thing without one."""
        self.names.setdefault(what, []).append(name)

    def sentences(self) -> tuple[str, ...]:
        """One sentence for each kind of thing."""
        found = []
        for what, names in self.names.items():
            given = [name for name in names if name]
            more = f" and {len(given) - _SHOWN} more" if len(given) > _SHOWN else ""
            listed = f": {', '.join(given[:_SHOWN])}{more}" if given else ""
            found.append(f"Left out, {what}{listed}.")
        return tuple(found)


def every_left_out(model: Any, left_out: LeftOut, off: set[str]) -> None:
    """Add everything of a compiled model that has no counterpart, but its loops and actuators.

    Args:
        off: names of what the model's own options switch off.
    """
    touching = int(np.sum((model.geom_contype != 0) | (model.geom_conaffinity != 0)))
    if touching and "CONTACT" not in off:
        left_out.add(f"contacts between its {touching} shapes", "")
    _of_joints(model, left_out)
    for k in range(model.ntendon):
        left_out.add("tendons", model.tendon(k).name or f"tendon_{k}")
    for k in range(model.nbody):
        if model.body_gravcomp[k]:
            left_out.add("compensation of gravity", model.body(k).name)
        if model.body_mocapid[k] >= 0:
            left_out.add("motion capture, whose bodies stand still", model.body(k).name)
    for k in range(model.nu):
        if model.actuator_ctrllimited[k] or model.actuator_forcelimited[k]:
            left_out.add("limits of actuators", model.actuator(k).name)
    if model.opt.density or model.opt.viscosity:
        left_out.add("forces of the surrounding medium", "")
    for what, count in (("flexible bodies", model.nflex), ("plugins", model.nplugin)):
        if count:
            left_out.add(what, "")


def _may_wind(model: Any, j: int) -> bool:
    """True if a hinge's spring can be wound by half a turn or more.

    MuJoCo counts the turns of a hinge; the angle here is that of the posture, so that the moment of
    a `TorsionalSpringDamper` jumps at half a turn.
    """
    if model.jnt_type[j] != _HINGE or not model.jnt_stiffness[j]:
        return False
    rest = model.qpos_spring[model.jnt_qposadr[j]]
    return not (model.jnt_limited[j] and np.all(np.abs(model.jnt_range[j] - rest) < np.pi))


def _of_joints(model: Any, left_out: LeftOut) -> None:
    """Add limits, dry friction, rotor inertia and nonlinear springs and dampers of joints."""
    # newer versions of MuJoCo have polynomial springs and dampers
    none = np.zeros((max(model.njnt, model.nv), 1))
    spring = getattr(model, "jnt_stiffnesspoly", none)
    yields = getattr(model, "jnt_springyield", none)
    damper = getattr(model, "dof_dampingpoly", none)
    for j in range(model.njnt):
        name, kind = model.joint(j).name or f"joint_{j}", model.jnt_type[j]
        dofs = slice(model.jnt_dofadr[j], model.jnt_dofadr[j] + {_FREE: 6, _BALL: 3}.get(kind, 1))
        checks = (
            ("limits of joints", model.jnt_limited[j]),
            ("dry friction in joints", np.any(model.dof_frictionloss[dofs])),
            ("armature of joints", np.any(model.dof_armature[dofs])),
            ("springs of ball and free joints", kind in (_FREE, _BALL) and model.jnt_stiffness[j]),
            ("damping of free joints", kind == _FREE and np.any(model.dof_damping[dofs])),
            ("turns of springs in hinges, which here act within half a turn", _may_wind(model, j)),
            ("nonlinear springs and dampers",
             np.any(spring[j]) or np.any(yields[j]) or np.any(damper[dofs])),
        )  # fmt: skip
        for what, there in checks:
            if there:
                left_out.add(what, name)
