"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .process import (
    system_model as system_model,
)
from .sensors import (
    AbstractSensor as AbstractSensor,
    Accelerometer as Accelerometer,
    AttitudeFix as AttitudeFix,
    Encoder as Encoder,
    Gyroscope as Gyroscope,
    PositionFix as PositionFix,
    SensedMotion as SensedMotion,
    readings as readings,
    seen_along as seen_along,
    seen_at as seen_at,
)
