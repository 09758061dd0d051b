"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .adaptation.adaptive import (
    AdaptiveController as AdaptiveController,
    AdaptiveMemory as AdaptiveMemory,
)
from .adaptation.moments import (
    Payload as Payload,
)
from .adaptation.payload_filter import (
    PayloadFilter as PayloadFilter,
    PayloadMemory as PayloadMemory,
)
from .closed_loop import (
    LoopCertificate as LoopCertificate,
    LoopRun as LoopRun,
    close_loop as close_loop,
)
from .design.gains import (
    TunedGains as TunedGains,
    tune_gains as tune_gains,
)
from .design.margin import (
    InputMargin as InputMargin,
    input_margin as input_margin,
    without_states as without_states,
)
from .design.schedule import (
    GainSchedule as GainSchedule,
    ScheduledFeedback as ScheduledFeedback,
    schedule_regulator as schedule_regulator,
)
from .design.shape import (
    Slew as Slew,
    within as within,
)
from .estimator import (
    Belief as Belief,
    EstimatorMemory as EstimatorMemory,
    MotionEstimate as MotionEstimate,
    MotionEstimator as MotionEstimator,
)
from .flying import (
    FlightController as FlightController,
    FlightMemory as FlightMemory,
    mass_properties as mass_properties,
    within_limits as within_limits,
)
from .geometric import (
    BaseMotion as BaseMotion,
    FlightGains as FlightGains,
    MassProperties as MassProperties,
    Waypoint as Waypoint,
    along as along,
    at_point as at_point,
    wrench_for as wrench_for,
)
from .inertial import (
    strapdown as strapdown,
)
from .instruments import (
    Instrument as Instrument,
    Reading as Reading,
)
from .panel import (
    PanelServo as PanelServo,
    StrokeServo as StrokeServo,
    facing as facing,
    inverse_dynamics as inverse_dynamics,
    panel_bodies as panel_bodies,
    panel_motion as panel_motion,
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
from .rolling import (
    LoopReason as LoopReason,
    Rollout as Rollout,
    Sample as Sample,
    rollout as rollout,
)
from .training.environment import (
    Environment as Environment,
    Episode as Episode,
)
from .training.gymnasium_env import (
    gymnasium_env as gymnasium_env,
    gymnasium_vector_env as gymnasium_vector_env,
)
from .uav import (
    UavController as UavController,
    UavReference as UavReference,
)
