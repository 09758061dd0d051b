"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .actuator import (
    LinearActuator as LinearActuator,
)
from .bodies import (
    tracker_bodies as tracker_bodies,
    tracker_joints as tracker_joints,
)
from .cells import (
    SolarCells as SolarCells,
)
from .day import (
    Day as Day,
    Imperfections as Imperfections,
    track_day as track_day,
)
from .forward import (
    angles_from_strokes as angles_from_strokes,
    follow as follow,
)
from .geometry import (
    TrackerGeometry as TrackerGeometry,
    initial_angles as initial_angles,
    tracker_geometry as tracker_geometry,
)
from .kinematics import (
    PairMotion as PairMotion,
    Reason as Reason,
    panel_angles as panel_angles,
    panel_normal as panel_normal,
    strokes as strokes,
)
from .placement import (
    TRACKER_BODIES as TRACKER_BODIES,
    Placement as Placement,
    place as place,
    posture as posture,
)
from .pointing import (
    aim as aim,
)
from .tracker_options import (
    Friction as Friction,
    PanelStart as PanelStart,
    Servo as Servo,
    Stops as Stops,
    Strokes as Strokes,
)
from .workspace import (
    Limits as Limits,
    survey as survey,
    tracker_limits as tracker_limits,
)
