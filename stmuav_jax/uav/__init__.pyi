"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .adaptation import (
    AdaptiveController as AdaptiveController,
    AdaptiveMemory as AdaptiveMemory,
    Payload as Payload,
    PayloadFilter as PayloadFilter,
    PayloadMemory as PayloadMemory,
)
from .airframe import (
    ENERGY as ENERGY,
    PART_I as PART_I,
    PART_II as PART_II,
    PRINTED_CENTRES as PRINTED_CENTRES,
    PRINTED_ORIENTATIONS as PRINTED_ORIENTATIONS,
)
from .allocation import (
    RotorLimits as RotorLimits,
    check_lift as check_lift,
    wrench_map as wrench_map,
)
from .battery import (
    Battery as Battery,
    endurance as endurance,
)
from .drag import (
    AirframeDrag as AirframeDrag,
    with_wind as with_wind,
)
from .environment.calendar import (
    unix_time as unix_time,
)
from .environment.ephemeris import (
    Air as Air,
    Place as Place,
    sun_direction as sun_direction,
)
from .environment.sun import (
    SensedDirection as SensedDirection,
    Sun as Sun,
    SunReason as SunReason,
    attitude as attitude,
    in_body as in_body,
    sensed_direction as sensed_direction,
    sensed_sun as sensed_sun,
    sun_at as sun_at,
    sun_in_body as sun_in_body,
    sun_position as sun_position,
    sun_position_spa as sun_position_spa,
)
from .environment.wind import (
    ChangingWind as ChangingWind,
    Gusts as Gusts,
    Turbulence as Turbulence,
    dryden as dryden,
    low_altitude as low_altitude,
)
from .flight import (
    FlightTrim as FlightTrim,
    TrimLimits as TrimLimits,
    TrimReason as TrimReason,
    Uav as Uav,
    trim_flight as trim_flight,
    trim_slopes as trim_slopes,
)
from .flight_controller import (
    BaseMotion as BaseMotion,
    FlightController as FlightController,
    FlightGains as FlightGains,
    FlightMemory as FlightMemory,
    MassProperties as MassProperties,
    UavController as UavController,
    UavReference as UavReference,
    mass_properties as mass_properties,
    within_limits as within_limits,
    wrench_for as wrench_for,
)
from .flight_identification.centre import (
    FilteredCentre as FilteredCentre,
    filter_centre as filter_centre,
    filter_hover_centre as filter_hover_centre,
    identify_hover_centre as identify_hover_centre,
)
from .flight_identification.record import (
    FlightRecord as FlightRecord,
    RotorLayout as RotorLayout,
    make_layout as make_layout,
)
from .flight_identification.stages import (
    FlightIdentification as FlightIdentification,
    FlightVerdict as FlightVerdict,
    ParameterEstimate as ParameterEstimate,
    identify_flight as identify_flight,
)
from .inner_motion import (
    JointChain as JointChain,
)
from .joint_controller import (
    DrivenJoint as DrivenJoint,
    JointController as JointController,
    JointGains as JointGains,
    JointMotions as JointMotions,
    JointReference as JointReference,
    driven_joints as driven_joints,
)
from .motion_estimator import (
    EstimatorMemory as EstimatorMemory,
    MotionEstimate as MotionEstimate,
    MotionEstimator as MotionEstimator,
)
from .motor import (
    MotorRotors as MotorRotors,
)
from .panel_servo import (
    PanelServo as PanelServo,
    StrokeServo as StrokeServo,
    facing as facing,
    inverse_dynamics as inverse_dynamics,
    panel_bodies as panel_bodies,
    panel_motion as panel_motion,
)
from .quadrotor.assessment import (
    CaseStudy as CaseStudy,
    FilterTuning as FilterTuning,
    consistent_tuning as consistent_tuning,
    estimate_case as estimate_case,
    report_tuning as report_tuning,
    study_case as study_case,
    summarise as summarise,
)
from .quadrotor.cases import (
    World as World,
    simulate_case as simulate_case,
    thrusts as thrusts,
)
from .quadrotor.model import (
    PART_III as PART_III,
    attitude_model as attitude_model,
    attitude_space as attitude_space,
    observable_model as observable_model,
    report_model as report_model,
    report_prior as report_prior,
    swinging_model as swinging_model,
)
from .rotor import (
    Rotors as Rotors,
    drag_power as drag_power,
    fit_rotor_curves as fit_rotor_curves,
    hover_power as hover_power,
    hover_speed_squared as hover_speed_squared,
    rotor_layout as rotor_layout,
)
from .scenes.flight_options import (
    BaseStart as BaseStart,
    Drag as Drag,
    FlightStart as FlightStart,
    Gear as Gear,
    Motor as Motor,
    Wind as Wind,
)
from .scenes.registry import (
    SCENES as SCENES,
    RegisteredScene as RegisteredScene,
    make_scene as make_scene,
)
from .scenes.uav_tracker import (
    make_uav as make_uav,
)
from .tracker.bodies import (
    TRACKER_BODIES as TRACKER_BODIES,
    Friction as Friction,
    LinearActuator as LinearActuator,
    PanelStart as PanelStart,
    Placement as Placement,
    Servo as Servo,
    Stops as Stops,
    Strokes as Strokes,
    place as place,
    place_on_base as place_on_base,
    posture as posture,
    tracker_bodies as tracker_bodies,
    tracker_joints as tracker_joints,
)
from .tracker.day import (
    Day as Day,
    Imperfections as Imperfections,
    track_day as track_day,
)
from .tracker.geometry import (
    TrackerGeometry as TrackerGeometry,
    initial_angles as initial_angles,
    tracker_geometry as tracker_geometry,
)
from .tracker.kinematics import (
    PairMotion as PairMotion,
    Reason as Reason,
    angles_from_strokes as angles_from_strokes,
    follow as follow,
    panel_angles as panel_angles,
    panel_normal as panel_normal,
    strokes as strokes,
)
from .tracker.workspace import (
    Limits as Limits,
    aim as aim,
    survey as survey,
    tracker_limits as tracker_limits,
)
