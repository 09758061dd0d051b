"""What both Pinocchio peers need: a tree in Pinocchio's terms, every number in link axes.

A link's frame is its joint's frame on the child, so that a link is: a placement in front of
the joint, the joint, and a body behind it.
"""

from dataclasses import dataclass

import numpy as np

from stmuav_jax import Scene

from .plain import Plain, Sinus, Start, UnsupportedError, plain
from .tree import IDENTITY, Frame, Tree, coordinates, span


@dataclass(frozen=True)
class LinkBody:
    """A link: joint kind, parent link (-1: ground), placement in the parent's axes, and body.

    mass [kg]; com (3,) [m] and inertia (3, 3) about it [kg m^2], in the link's axes.
    """

    kind: str
    parent: int
    placement: Frame
    mass: float
    com: np.ndarray
    inertia: np.ndarray


@dataclass(frozen=True)
class LinkModel:
    """Links and all that acts on them, in link axes and about link origins.

    Attributes:
        bodies: (link, centre of mass), in the scene's order.
        wrenches: (link, force, moment). actuators: (base, slider, point, axis, force), point
            and axis in the base's link. forces: (link, point, force), force in world axes.
        cuts: (link a, point a, link b, point b), points that must coincide.
    """

    links: tuple[LinkBody, ...]
    gravity: np.ndarray
    bodies: tuple[tuple[int, np.ndarray], ...]
    wrenches: tuple[tuple[int, np.ndarray, np.ndarray], ...]
    actuators: tuple[tuple[int, int, np.ndarray, np.ndarray, Sinus], ...]
    forces: tuple[tuple[int, np.ndarray, Sinus], ...]
    cuts: tuple[tuple[int, np.ndarray, int, np.ndarray], ...]


def link_model(model: Plain, tree: Tree) -> LinkModel:
    """The tree with every number in link axes."""
    # a body's frame at its centre of mass, in the axes of the link that carries it
    body = [tree.links[link].on_child.inverse() for link in tree.carrier] + [IDENTITY]
    link = (*tree.carrier, -1)

    def at(k: int, point: np.ndarray) -> tuple[int, np.ndarray]:
        return link[k], body[k].R @ point + body[k].x

    links = []
    for one in tree.links:
        F = body[one.child]
        links.append(
            LinkBody(
                one.kind,
                one.ahead,
                body[one.parent] @ one.on_parent,
                float(model.mass[one.child]),
                F.x,
                F.R @ model.inertia[one.child] @ F.R.T,
            )
        )
    wrenches = [
        (link[k], body[k].R @ f, body[k].R @ m + np.cross(body[k].x, body[k].R @ f))
        for k, f, m in model.wrenches
    ]
    actuators = [
        (link[a.base], link[a.slider], at(a.base, a.arm)[1], body[a.base].R[:, 2], a.force)
        for a in model.actuators
    ]
    zero = np.zeros(3)
    return LinkModel(
        tuple(links),
        model.gravity,
        tuple(at(k, zero) for k in range(model.n)),
        tuple(wrenches),
        tuple(actuators),
        tuple((*at(k, zero), force) for k, force in model.forces),
        tuple((*at(c.i, c.point_i), *at(c.j, c.point_j)) for c in tree.cuts),
    )


def generalised(
    links: LinkModel,
) -> tuple[np.ndarray, list[tuple[np.ndarray, tuple[float, float]]]]:
    """Loads as joint forces: a constant, and (column, (rate, phase)) of what swings in time.

    Only loads that do not depend on the posture: a wrench in the axes of a free link, an
    actuator along the slide that it drives, a force on a body that can only slide.

    Raises:
        UnsupportedError: another load.
    """
    width = {"free": 6, "turn": 1, "slide": 1, "universal": 2}
    ends = np.cumsum([0, *(width[link.kind] for link in links.links)])
    constant = np.zeros(ends[-1])
    waves = []

    def wave(link: int, direction: np.ndarray, force: Sinus) -> None:
        column = np.zeros(ends[-1])
        column[ends[link]] = np.sum(links.links[link].placement.R[:, 2] * direction)
        waves.append((column, (force.rate, force.phase)))

    for k, force, moment in links.wrenches:
        if links.links[k].kind != "free":
            raise UnsupportedError("A moment acts on a body that is not free.")
        constant[ends[k] : ends[k + 1]] += np.concatenate([force, moment])
    for base, slider, _, axis, force in links.actuators:
        link = links.links[slider]
        if (
            link.kind != "slide"
            or link.parent != base
            or abs(link.placement.R[:, 2] @ axis) < 1 - 1e-12
        ):
            raise UnsupportedError("An actuator is not along the slide that it drives.")
        wave(slider, axis * force.amplitude, force)
    for k, _, force in links.forces:
        if links.links[k].kind != "slide" or links.links[k].parent != -1:
            raise UnsupportedError("A force acts on a body that does not slide on ground.")
        wave(k, force.amplitude, force)
    return constant, waves


def why_no_joint_forces(scene: Scene) -> str:
    """Why a scene is no tree with joint forces that depend on time alone; empty if it is."""
    try:
        numbers = plain(scene)
        generalised(link_model(numbers, span(numbers)))
    except UnsupportedError as error:
        return str(error)
    return ""


def start_vectors(tree: Tree, state: Start) -> tuple[np.ndarray, np.ndarray]:
    """Pinocchio's q (quaternion x, y, z, w) and v (free joint: velocity in body axes)."""
    q, v = [], []
    for link, (position, rates) in zip(tree.links, coordinates(tree, state), strict=True):
        if link.kind == "free":
            position = position[[0, 1, 2, 4, 5, 6, 3]]
            R = state.R_wb[link.child]
            rates = np.concatenate([R.T @ rates[:3], rates[3:]])
        q.append(position)
        v.append(rates)
    return np.concatenate(q), np.concatenate(v)


def model_text(model: LinkModel) -> str:
    """The model as words and numbers that the C++ program reads in turn."""
    lines = [f"links {len(model.links)}"]
    for link in model.links:
        F = link.placement
        numbers = [*F.R.ravel(), *F.x, link.mass, *link.com, *link.inertia.ravel()]
        lines.append(f"{link.kind} {link.parent} {_text(numbers)}")
    lines.append(f"gravity {_text(model.gravity)}")
    lines.append(f"bodies {len(model.bodies)}")
    lines += [f"{k} {_text(x)}" for k, x in model.bodies]
    lines.append(f"wrenches {len(model.wrenches)}")
    lines += [f"{k} {_text([*f, *m])}" for k, f, m in model.wrenches]
    lines.append(f"actuators {len(model.actuators)}")
    for base, slider, point, axis, s in model.actuators:
        numbers = [*point, *axis, float(s.amplitude), s.rate, s.phase]
        lines.append(f"{base} {slider} {_text(numbers)}")
    lines.append(f"forces {len(model.forces)}")
    for k, point, s in model.forces:
        lines.append(f"{k} {_text([*point, *s.amplitude, s.rate, s.phase])}")
    lines.append(f"cuts {len(model.cuts)}")
    lines += [f"{a} {_text(x)} {b} {_text(y)}" for a, x, b, y in model.cuts]
    return "\n".join(lines) + "\n"


def starts_text(starts: list[tuple[float, np.ndarray, np.ndarray]]) -> str:
    """Start times and vectors (t0, q, v), one per line."""
    lines = [str(len(starts)), *(f"{t!r} {_text([*q, *v])}" for t, q, v in starts)]
    return "\n".join(lines) + "\n"


def _text(numbers: object) -> str:
    return " ".join(repr(float(x)) for x in np.ravel(np.asarray(numbers)))
