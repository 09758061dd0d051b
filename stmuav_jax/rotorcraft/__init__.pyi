"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .allocation import (
    Allocation as Allocation,
    AllocationReason as AllocationReason,
    RotorLimits as RotorLimits,
    allocate as allocate,
    check_lift as check_lift,
    wrench_map as wrench_map,
)
from .battery import (
    Battery as Battery,
    BatteryReason as BatteryReason,
    Discharge as Discharge,
    discharge as discharge,
    endurance as endurance,
)
from .drag import (
    AirframeDrag as AirframeDrag,
)
from .motor import (
    MotorRotors as MotorRotors,
)
from .power import (
    drag_power as drag_power,
    figure_of_merit as figure_of_merit,
    hover_power as hover_power,
    induced_power as induced_power,
)
from .rotor import (
    Rotors as Rotors,
    hover_speed_squared as hover_speed_squared,
)
