"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .airframe import (
    PART_I as PART_I,
    PART_II as PART_II,
    PRINTED_CENTRES as PRINTED_CENTRES,
    PRINTED_ORIENTATIONS as PRINTED_ORIENTATIONS,
)
from .energy import (
    ENERGY as ENERGY,
)
from .table import (
    Parameter as Parameter,
    Parameters as Parameters,
)
