"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .equilibrium import (
    FlightCondition as FlightCondition,
    Trim as Trim,
    climb as climb,
    cruise as cruise,
    hover as hover,
    steady_turn as steady_turn,
    trim as trim,
    trim_condition as trim_condition,
)
from .fit_statistics import (
    Deviations as Deviations,
    FitVerdict as FitVerdict,
)
from .identification import (
    IdentifiabilityError as IdentifiabilityError,
    Identified as Identified,
    MotionModel as MotionModel,
    Unknown as Unknown,
    check_identifiable as check_identifiable,
    from_table as from_table,
    identify as identify,
    motion_model as motion_model,
    numbers_of as numbers_of,
    start_from_readings as start_from_readings,
)
from .linear import (
    Linear as Linear,
    linearize as linearize,
)
from .mass_properties import (
    Moments as Moments,
    mass_moments as mass_moments,
)
from .multiple_shooting import (
    make_shooting as make_shooting,
)
from .path_inverse_dynamics import (
    Clearance as Clearance,
    PathEfforts as PathEfforts,
    compare_clearances as compare_clearances,
    inverse_dynamics as inverse_dynamics,
)
from .posture_survey import (
    Survey as Survey,
    survey as survey,
)
from .sensors import (
    SENSORS as SENSORS,
    AbstractSensor as AbstractSensor,
    Accelerometer as Accelerometer,
    AttitudeFix as AttitudeFix,
    Encoder as Encoder,
    Gyroscope as Gyroscope,
    Output as Output,
    PositionFix as PositionFix,
    SensedMotion as SensedMotion,
    joint_outputs as joint_outputs,
    readings as readings,
    sensed_motion_along as sensed_motion_along,
    sensed_motion_at as sensed_motion_at,
    system_model as system_model,
)
from .tuning import (
    InputTuning as InputTuning,
    Limit as Limit,
    TunedMotion as TunedMotion,
    departures as departures,
    end_at as end_at,
    joint_forces as joint_forces,
    roughness as roughness,
    tune_inputs as tune_inputs,
    tune_slew as tune_slew,
)
