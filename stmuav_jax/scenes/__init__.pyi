"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .flight_options import (
    BaseStart as BaseStart,
    Drag as Drag,
    FlightStart as FlightStart,
    Gear as Gear,
    Motor as Motor,
    Wind as Wind,
)
from .registry import (
    SCENES as SCENES,
    RegisteredScene as RegisteredScene,
    make_scene as make_scene,
)
from .spin import (
    spin_exact as spin_exact,
)
from .uav_tracker import (
    uav_flyer as uav_flyer,
)
