"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .allocation import (
    Allocation as Allocation,
    AllocationReason as AllocationReason,
    RotorLimits as RotorLimits,
    allocate as allocate,
    check_lift as check_lift,
    wrench_map as wrench_map,
)
from .drag import (
    AirframeDrag as AirframeDrag,
)
from .motor import (
    MotorRotors as MotorRotors,
)
from .rotor import (
    Rotors as Rotors,
    hover_speed_squared as hover_speed_squared,
)
