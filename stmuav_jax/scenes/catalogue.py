"""What there is to say about each scene without building it; `registry.py` builds them."""

from typing import NamedTuple


class Line(NamedTuple):
    """cases: of the report, empty where there is one only. t1: where the scene ends [s].

    summary: one line. source: in the report.
    """

    cases: tuple[int, ...]
    summary: str
    source: str
    t1: float


CATALOGUE = {
    "spin": Line((), "a body on a ball joint, with a closed form", "Part I, 4.3", 5.0),
    "tracker": Line((1, 2, 3), "the tracker on fixed ground", "Part I, ch. 5", 2.0),
    "hexacopter": Line((), "one free body, six rotors", "Part II, 5.1", 2.0),
    "uav_tracker": Line((1, 2, 3), "hexacopter with tracker", "Part II, 5.2", 2.0),
}
