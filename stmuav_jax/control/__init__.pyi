"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .closed_loop import (
    LoopCertificate as LoopCertificate,
    LoopRun as LoopRun,
    close_loop as close_loop,
)
from .instruments import (
    Instrument as Instrument,
    Reading as Reading,
)
from .plant import (
    Plant as Plant,
    PlantState as PlantState,
)
from .quadratic import (
    Regulator as Regulator,
    StateFeedback as StateFeedback,
    held_matrices as held_matrices,
    point_of as point_of,
    regulator as regulator,
)
from .rolling import (
    LoopReason as LoopReason,
    Rollout as Rollout,
    Sample as Sample,
    rollout as rollout,
)
