"""The package's public names; `__init__.py` reads them from here and imports each when it is used."""

from .algebra.compiler import compiler_options, outer_jit
from .algebra.rotation import (
    angular_velocity,
    conjugate,
    euler_parameter_rate,
    from_matrix,
    from_rotation_vector,
    matrix_g,
    matrix_l,
    normalise,
    product,
    rotation_matrix,
    skew,
    to_rotation_vector,
)
from .dynamics.analysis import Evaluation, evaluate
from .dynamics.augmented import Augmented
from .dynamics.dense import states_at
from .dynamics.energy import Energy, energy, momentum
from .dynamics.formulation import Accelerations, Reactions
from .dynamics.initial import Assembly, Rank, assemble, rank, ranks
from .dynamics.integrate import Trajectory, integrate
from .dynamics.joint_start import state_from_joints
from .dynamics.prescribed import (
    KinematicPath,
    PathReason,
    driven,
    driver_efforts,
    kinematic_path,
)
from .dynamics.problem import Method
from .dynamics.reactions import joint_reactions, reaction_on
from .dynamics.rosenbrock import Rodas5P
from .dynamics.run import Certificate, Run
from .dynamics.scene import Scene
from .dynamics.simulate import simulate
from .dynamics.solvers import kvaerno3, kvaerno5
from .dynamics.stabilisation import Baumgarte, Projection, Unstabilised
from .dynamics.stiffness import choose_solver, spectrum
from .dynamics.topology import SpanningTree, spanning_tree
from .dynamics.tree import Tree
from .estimation.assess import CaseStudy, estimate_case, study_case, summarise
from .estimation.attitude import attitude_model, attitude_space
from .estimation.bank import filter_bank
from .estimation.cases import World, simulate_case
from .estimation.consistency import (
    autocorrelation,
    chi2_interval,
    inconsistent,
    mean_interval,
    nees,
    path_nees,
)
from .estimation.extended import extended_model, extended_noise, inertia_matrix, inertia_states
from .estimation.filter import EstimationError, Filtered, kalman_filter
from .estimation.gaussian import Gaussian, gaussian
from .estimation.hover import Loop, hover_model, simulate_hover
from .estimation.likelihood import Tuned, record_likelihood, standard_errors, tune
from .estimation.model import Sensor, StateSpaceModel
from .estimation.observability import Observability, observability
from .estimation.online import Estimate, OnlineFilter
from .estimation.propagate import euler, rk4
from .estimation.quadrotor import PART_III, observable_model, report_model, report_prior
from .estimation.rotorcraft import Moved, moved, rotorcraft_model
from .estimation.sigma import Cubature, Cubature5, Linearised, Unscented
from .estimation.smoother import Smoothed, smooth
from .estimation.space import Angle, Composite, Rotation, Vector
from .estimation.tuning import Tuning, consistent_tuning, report_tuning
from .estimation.update import Innovation, predict, update
from .estimation.verdict import RunsVerdict, Verdict, over_runs, verdict, verdicts
from .mechanics.body import GROUND, Body
from .mechanics.compound import Part, box, compound, cylinder, point_mass, rod, sphere
from .mechanics.errors import ModelError, SettingError, SimulationError, StateError
from .mechanics.force import (
    AppliedForce,
    AppliedMoment,
    Gravity,
    JointDamping,
    LinearSpringDamper,
    TorsionalSpringDamper,
)
from .mechanics.internal import AbstractInternalForce, internal_names, with_internal
from .mechanics.joint import (
    Joint,
    cylindrical,
    distance,
    drive,
    revolute,
    revolute_spherical,
    spherical,
    translational,
    universal,
    weld,
)
from .mechanics.joint_effort import JointEffort
from .mechanics.joint_force import EndStop, JointFriction, JointServo
from .mechanics.joint_motion import JointMotion, joint_motion
from .mechanics.load import Load, Sine
from .mechanics.sampled import Sampled
from .mechanics.state import Kinematics, State
from .mechanics.system import System
from .montecarlo.batch import FlightWork
from .montecarlo.distribution import Distribution
from .montecarlo.distribution import from_plain as distribution_from_plain
from .montecarlo.estimates import EstimationStudy, EstimationWork
from .montecarlo.flights import Flights, flights
from .montecarlo.gradient import final_gradients
from .montecarlo.precision import precision_error
from .montecarlo.ready import READY, make_work, ready
from .montecarlo.sampling import Sampling, sampling_from_plain
from .montecarlo.study import Quantity, Study, study_from_plain
from .montecarlo.work import AbstractWork, Axis, Column
from .scenes.registry import SCENES, make_scene
from .scenes.spin import spin_exact
from .scenes.uav_tracker import uav_flyer
from .study.day import Day, Flaws, track_day
from .study.identify import (
    IdentifiabilityError,
    Identified,
    Unknown,
    flight_model,
    identify,
    identify_many,
)
from .study.linear import Linear, linearize
from .study.loads import (
    Envelope,
    JointLoads,
    envelope,
    joint_loads,
    resolved_loads,
    run_loads,
    smooth_peaks,
)
from .study.search import Search, SearchReason, search
from .study.sensed import (
    Flight,
    centre_of_mass,
    inertia_about_centre,
    sensed_flight,
)
from .study.shooting import growth, shooting, transition
from .study.trim import Trim, TrimLimits, TrimReason, climb, cruise, hover, steady_turn, trim
from .study.tuning import SlewLimits, at_rest, hold, holding_time, peaks, slew
from .vehicle.actuator import LinearActuator
from .vehicle.airframe import PART_I, PART_II, PRINTED_ORIENTATIONS
from .vehicle.allocation import (
    Allocation,
    AllocationReason,
    RotorLimits,
    allocate,
    check_lift,
    wrench_map,
)
from .vehicle.drag import AirframeDrag
from .vehicle.drive import Friction, Servo, Stops
from .vehicle.ephemeris import Air, Place, sun_direction, unix_time
from .vehicle.flight import Drag, Motor, Wind
from .vehicle.flyer import Coordinates, Flyer, Inputs
from .vehicle.forward import angles_from_strokes, follow
from .vehicle.geometry import TrackerGeometry, initial_angles, tracker_geometry
from .vehicle.gust import Gusts, Turbulence, dryden, low_altitude
from .vehicle.kinematics import Reason, panel_angles, panel_normal, strokes
from .vehicle.motor import MotorRotors
from .vehicle.parameters import Parameter, Parameters
from .vehicle.placement import posture
from .vehicle.pointing import aim
from .vehicle.rotor import Rotors, hover_speed_squared
from .vehicle.sun import (
    Sun,
    SunReason,
    attitude,
    sensed_sun,
    sun_at,
    sun_in_body,
    sun_position,
)
from .vehicle.tracker import tracker_bodies, tracker_joints
from .vehicle.workspace import Limits, survey, tracker_limits

__version__: str

# fmt: off
__all__ = [
    "GROUND", "PART_I", "PART_II", "PART_III", "PRINTED_ORIENTATIONS", "READY", "SCENES",
    "AbstractInternalForce", "AbstractWork", "Accelerations", "Air", "AirframeDrag",
    "Allocation", "AllocationReason", "Angle", "AppliedForce", "AppliedMoment", "Assembly",
    "Augmented", "Axis", "Baumgarte", "Body", "CaseStudy", "Certificate", "Column", "Composite",
    "Coordinates", "Cubature", "Cubature5", "Day", "Distribution", "Drag", "EndStop", "Energy",
    "Envelope", "Estimate", "EstimationError", "EstimationStudy", "EstimationWork",
    "Evaluation", "Filtered", "Flaws", "Flight", "FlightWork", "Flights", "Flyer", "Friction",
    "Gaussian", "Gravity", "Gusts", "IdentifiabilityError", "Identified", "Innovation",
    "Inputs", "Joint", "JointDamping", "JointEffort", "JointFriction", "JointLoads",
    "JointMotion", "JointServo", "KinematicPath", "Kinematics", "Limits", "Linear",
    "LinearActuator", "LinearSpringDamper", "Linearised", "Load", "Loop", "Method",
    "ModelError", "Motor", "MotorRotors", "Moved", "Observability", "OnlineFilter", "Parameter",
    "Parameters", "Part", "PathReason", "Place", "Projection", "Quantity", "Rank", "Reactions",
    "Reason", "Rodas5P", "Rotation", "RotorLimits", "Rotors", "Run", "RunsVerdict", "Sampled",
    "Sampling", "Scene", "Search", "SearchReason", "Sensor", "Servo", "SettingError",
    "SimulationError", "Sine", "SlewLimits", "Smoothed", "SpanningTree", "State", "StateError",
    "StateSpaceModel", "Stops", "Study", "Sun", "SunReason", "System", "TorsionalSpringDamper",
    "TrackerGeometry", "Trajectory", "Tree", "Trim", "TrimLimits", "TrimReason", "Tuned",
    "Tuning", "Turbulence", "Unknown", "Unscented", "Unstabilised", "Vector", "Verdict", "Wind",
    "World", "aim", "allocate", "angles_from_strokes", "angular_velocity", "assemble",
    "at_rest", "attitude", "attitude_model", "attitude_space", "autocorrelation", "box",
    "centre_of_mass", "check_lift", "chi2_interval", "choose_solver", "climb",
    "compiler_options", "compound", "conjugate", "consistent_tuning", "cruise", "cylinder",
    "cylindrical", "distance", "distribution_from_plain", "drive", "driven", "driver_efforts",
    "dryden", "energy", "envelope", "estimate_case", "euler", "euler_parameter_rate",
    "evaluate", "extended_model", "extended_noise", "filter_bank", "final_gradients",
    "flight_model", "flights", "follow", "from_matrix", "from_rotation_vector", "gaussian",
    "growth", "hold", "holding_time", "hover", "hover_model", "hover_speed_squared", "identify",
    "identify_many", "inconsistent", "inertia_about_centre", "inertia_matrix", "inertia_states",
    "initial_angles", "integrate", "internal_names", "joint_loads", "joint_motion",
    "joint_reactions", "kalman_filter", "kinematic_path", "kvaerno3", "kvaerno5", "linearize",
    "low_altitude", "make_scene", "make_work", "matrix_g", "matrix_l", "mean_interval",
    "momentum", "moved", "nees", "normalise", "observability", "observable_model", "outer_jit",
    "over_runs", "panel_angles", "panel_normal", "path_nees", "peaks", "point_mass", "posture",
    "precision_error", "predict", "product", "rank", "ranks", "reaction_on", "ready",
    "record_likelihood", "report_model", "report_prior", "report_tuning", "resolved_loads",
    "revolute", "revolute_spherical", "rk4", "rod", "rotation_matrix", "rotorcraft_model",
    "run_loads", "sampling_from_plain", "search", "sensed_flight", "sensed_sun", "shooting",
    "simulate", "simulate_case", "simulate_hover", "skew", "slew", "smooth", "smooth_peaks",
    "spanning_tree", "spectrum", "sphere", "spherical", "spin_exact", "standard_errors",
    "state_from_joints", "states_at", "steady_turn", "strokes", "study_case",
    "study_from_plain", "summarise", "sun_at", "sun_direction", "sun_in_body", "sun_position",
    "survey", "to_rotation_vector", "track_day", "tracker_bodies", "tracker_geometry",
    "tracker_joints", "tracker_limits", "transition", "translational", "trim", "tune",
    "uav_flyer", "universal", "unix_time", "update", "verdict", "verdicts", "weld",
    "with_internal", "wrench_map",
]
# fmt: on
