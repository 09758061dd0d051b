"""What both Pinocchio peers need: a tree in Pinocchio's terms, every number in link axes.

A link's frame is its joint's frame on the child, so that a link is: a placement in front of
the joint, the joint, and a body behind it.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from problems.plain import Plain, Sinus, UnsupportedError, axes, plain, why_not
from problems.tree import IDENTITY, Frame, Tree, coordinates, span

from stmuav_jax import Scene, State


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
        cuts: (link a, point a, link b, point b), points that must coincide in the world
            directions `closed` (rows, 3).
        moments: (link, moment), in world axes. springs: (link a, point a, link b, point b,
            stiffness, damping, length). servos: (link, stiffness, damping, target) of slides, in
            the link's own coordinate.
    """

    links: tuple[LinkBody, ...]
    gravity: np.ndarray
    bodies: tuple[tuple[int, np.ndarray], ...]
    wrenches: tuple[tuple[int, np.ndarray, np.ndarray], ...]
    actuators: tuple[tuple[int, int, np.ndarray, np.ndarray, Sinus], ...]
    forces: tuple[tuple[int, np.ndarray, Sinus], ...]
    cuts: tuple[tuple[int, np.ndarray, int, np.ndarray], ...]
    closed: np.ndarray
    moments: tuple[tuple[int, np.ndarray], ...]
    springs: tuple[tuple[int, np.ndarray, int, np.ndarray, float, float, float], ...]
    servos: tuple[tuple[int, float, float, float], ...]


def linked(scene: Scene) -> tuple[Tree, LinkModel]:
    """A scene's tree, and the tree with every number in link axes."""
    model = plain(scene)
    tree = span(scene, model)
    # a body's frame at its centre of mass, in the axes of the link that carries it
    body = [tree.links[link].on_child.inverse() for link in tree.carrier] + [IDENTITY]
    link = (*tree.carrier, -1)

    def at(k: int, point: np.ndarray) -> tuple[int, np.ndarray]:
        return link[k], body[k].R @ point + body[k].x

    links = []
    for one in tree.links:
        F = body[one.child]
        place, mass = body[one.parent] @ one.on_parent, float(model.mass[one.child])
        inertia = F.R @ model.inertia[one.child] @ F.R.T
        links.append(LinkBody(one.kind, one.ahead, place, mass, F.x, inertia))
    wrenches = [
        (link[k], body[k].R @ f, body[k].R @ m + np.cross(body[k].x, body[k].R @ f))
        for k, f, m in model.wrenches
    ]
    actuators = [
        (link[a.base], link[a.slider], at(a.base, a.arm)[1], body[a.base].R[:, 2], a.force)
        for a in model.actuators
    ]
    zero = np.zeros(3)
    ends = lambda c: (*at(c.i, c.point_i), *at(c.j, c.point_j))
    return tree, LinkModel(
        links=tuple(links), gravity=model.gravity,
        bodies=tuple(at(k, zero) for k in range(model.n)),
        wrenches=tuple(wrenches), actuators=tuple(actuators),
        forces=tuple((*at(k, zero), force) for k, force in model.forces),
        cuts=tuple(ends(c) for c in tree.cuts),
        closed=np.eye(3) if tree.plane is None else tree.plane,
        moments=tuple((link[k], moment) for k, moment in model.moments),
        springs=tuple((*ends(s), s.stiffness, s.damping, s.length) for s in model.springs),
        servos=tuple(_servos(model, tree)),
    )  # fmt: skip


def _servos(model: Plain, tree: Tree) -> Iterator[tuple[int, float, float, float]]:
    """Servos by the link that slides; a slide led from its second body counts the other way."""
    for servo in model.servos:
        joint = model.joints[servo.joint]
        number = next((k for k, one in enumerate(tree.links) if one.joint is joint), None)
        if number is None:
            raise UnsupportedError("A servo in a joint at which a loop is cut")
        sign = 1.0 if tree.links[number].parent == joint.i else -1.0
        yield number, servo.stiffness, servo.damping, sign * servo.target


# Velocity coordinates of a link.
WIDTH = {"free": 6, "ball": 3, "turn": 1, "slide": 1, "universal": 2}


def generalised(links: LinkModel) -> tuple[np.ndarray, list[tuple[np.ndarray, Sinus]]]:
    """Loads as joint forces: a constant, and (column, signal) of what swings in time.

    Only loads that do not depend on the posture: a wrench in the axes of a free link, an
    actuator along the slide that it drives, a force on a body that can only slide.

    Raises:
        UnsupportedError: another load.
    """
    ends = np.cumsum([0, *(WIDTH[link.kind] for link in links.links)])
    constant = np.zeros(ends[-1])
    waves = []

    def wave(link: int, direction: np.ndarray, force: Sinus) -> None:
        column = np.zeros(ends[-1])
        column[ends[link]] = np.sum(links.links[link].placement.R[:, 2] * direction)
        waves.append((column, force))

    for k, force, moment in links.wrenches:
        if links.links[k].kind != "free":
            raise UnsupportedError("A body-fixed wrench on a body that is not free")
        constant[ends[k] : ends[k + 1]] += np.concatenate([force, moment])
    for base, slider, _, axis, force in links.actuators:
        link = links.links[slider]
        along = abs(link.placement.R[:, 2] @ axis)
        if (link.kind, link.parent) != ("slide", base) or along < 1 - 1e-12:
            raise UnsupportedError("An actuator across its slide")
        wave(slider, axis * force.amplitude, force)
    for k, _, force in links.forces:
        if (links.links[k].kind, links.links[k].parent) != ("slide", -1):
            raise UnsupportedError("A force on a body that does not slide on ground")
        wave(k, force.amplitude, force)
    return constant, waves


def why_no_joint_forces(scene: Scene) -> str:
    """What lacks for a scene as a tree whose driving forces are joint forces; empty if nothing."""
    return why_not(scene, lambda scene: generalised(linked(scene)[1]))


def start_vectors(tree: Tree, state: State) -> tuple[np.ndarray, np.ndarray]:
    """Pinocchio's q (quaternion x, y, z, w) and v (free joint: velocity in body axes)."""
    q, v = [], []
    for link, (position, rates) in zip(tree.links, coordinates(tree, state), strict=True):
        if link.kind == "free":
            position = position[[0, 1, 2, 4, 5, 6, 3]]
            R = axes(state.p[link.child])
            rates = np.concatenate([R.T @ rates[:3], rates[3:]])
        elif link.kind == "ball":
            position = position[[1, 2, 3, 0]]
        q.append(position)
        v.append(rates)
    return np.concatenate(q), np.concatenate(v)


def model_text(model: LinkModel) -> str:
    """The model as words and numbers that the C++ program reads in turn."""
    links = [
        f"{link.kind} {link.parent} "
        + _text((link.placement.R, link.placement.x, link.mass, link.com, link.inertia))
        for link in model.links
    ]
    rows = lambda name: [f"{name} {len(getattr(model, name))}", *map(_text, getattr(model, name))]
    lines = [f"links {len(links)}", *links, f"gravity {_text(model.gravity)}"]
    for name in ("bodies", "wrenches", "actuators", "forces", "cuts"):
        lines += rows(name)
    lines += [f"closed {len(model.closed)}", _text(model.closed)]
    return "\n".join([*lines, *rows("moments"), *rows("springs"), *rows("servos")]) + "\n"


def starts_text(starts: list[tuple[float, np.ndarray, np.ndarray]]) -> str:
    """Start times and vectors (t0, q, v), one per line."""
    lines = [str(len(starts)), *(f"{t!r} {_text((q, v))}" for t, q, v in starts)]
    return "\n".join(lines) + "\n"


def _text(value: Any) -> str:
    """Numbers one after the other, however they are nested."""
    if isinstance(value, Sinus):
        value = (value.amplitude, value.rate, value.phase)
    if isinstance(value, int):
        return str(value)
    if not isinstance(value, tuple) and np.ndim(value) == 0:
        return repr(float(value))
    return " ".join(_text(part) for part in value)
