"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .closed_loop import (
    LoopCertificate as LoopCertificate,
    LoopReason as LoopReason,
    LoopRun as LoopRun,
    Rollout as Rollout,
    Sample as Sample,
    close_loop as close_loop,
    rollout as rollout,
)
from .instruments import (
    Instrument as Instrument,
    Reading as Reading,
    SensorFault as SensorFault,
)
from .plant import (
    Plant as Plant,
    PlantState as PlantState,
)
from .quadratic import (
    Regulator as Regulator,
    StateFeedback as StateFeedback,
    check_observable as check_observable,
    held_matrices as held_matrices,
    point_of as point_of,
    regulator as regulator,
)
from .references import (
    Slew as Slew,
    Waypoint as Waypoint,
    at_point as at_point,
    follow_path as follow_path,
)
