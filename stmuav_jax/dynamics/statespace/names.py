"""Names and units of independent coordinates and their velocities."""

from ..tree.frames import columns
from ..tree.topology import SpanningTree

BASE = (
    *((f"r_{k}", "m") for k in "xyz"),
    *((f"theta_{k}", "rad") for k in "xyz"),
    *((f"v_{k}", "m/s") for k in "xyz"),
    *((f"omega_{k}", "rad/s") for k in "xyz"),
)


def velocity_names(tree: SpanningTree) -> tuple[tuple[str, str], ...]:
    """Name and unit of every velocity of the spanning tree, as those of its coordinate.

    The names are `joint.angle`, `joint.displacement`, `joint.angle_1` and `joint.angle_2` of a universal
    joint, `joint.rotation_x` of a spherical one, `body.displacement_x` of a free body.
    """
    found: list[tuple[str, str]] = []
    owners = [
        tree.joints[s.joint] if s.joint is not None else tree.bodies[s.body] for s in tree.steps
    ]
    labels = [
        [(owner, name.replace(" vector", "").replace(", ", "_"), unit) for name, unit in own]
        for owner, own in zip(owners, (s.motion.coordinates for s in tree.steps), strict=True)
    ]
    every = [(owner, name) for step in labels for owner, name, _ in step]
    seen: dict[tuple[str, str], int] = {}
    for step in labels:
        for owner, name, unit in step:
            seen[owner, name] = seen.get((owner, name), 0) + 1
            number = f"_{seen[owner, name]}" if every.count((owner, name)) > 1 else ""
            found.append((f"{owner}.{name}{number}", unit))
    return tuple(found)


def signs_of(tree: SpanningTree) -> list[float]:
    """Signs of the tree's velocities: -1 for scalar motions of joints passed from j to i."""
    backward = {link.joint for link in tree.links if not link.forward}
    own = []
    for f in columns(tree).frame:
        step = tree.steps[f - 1]
        own.append(-1.0 if step.joint in backward and not step.motion.velocities else 1.0)
    return own
