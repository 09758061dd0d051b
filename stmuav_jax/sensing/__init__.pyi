"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .outputs import (
    Output as Output,
    joint_outputs as joint_outputs,
)
from .process import (
    system_model as system_model,
)
from .sensors import (
    SENSORS as SENSORS,
    AbstractSensor as AbstractSensor,
    Accelerometer as Accelerometer,
    AttitudeFix as AttitudeFix,
    Encoder as Encoder,
    Gyroscope as Gyroscope,
    PositionFix as PositionFix,
    SensedMotion as SensedMotion,
    readings as readings,
    sensed_motion_along as sensed_motion_along,
    sensed_motion_at as sensed_motion_at,
)
