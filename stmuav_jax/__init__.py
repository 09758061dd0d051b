"""Differentiable simulation of a UAV that carries a parallel-mechanism solar tracker.

Conventions (frames, Euler parameters, signs, units): docs/conventions.md.
"""

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
from .dynamics.formulation import Accelerations
from .dynamics.initial import Assembly, Rank, assemble, rank
from .dynamics.integrate import Method, Trajectory, integrate
from .dynamics.reactions import Reactions, joint_reactions
from .dynamics.run import Certificate, Run
from .dynamics.scene import Scene
from .dynamics.simulate import simulate
from .dynamics.solvers import kvaerno3, kvaerno5
from .dynamics.stabilisation import Baumgarte, Projection, Unstabilised
from .mechanics.body import GROUND, Body
from .mechanics.errors import ModelError, SettingError, SimulationError, StateError
from .mechanics.force import (
    AppliedForce,
    AppliedMoment,
    Gravity,
    JointDamping,
    LinearSpringDamper,
    TorsionalSpringDamper,
)
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
from .mechanics.load import Load, Sine
from .mechanics.state import Kinematics, State
from .mechanics.system import System
from .scenes.registry import SCENES, make_scene
from .scenes.spin import spin_exact
from .vehicle.actuator import LinearActuator
from .vehicle.airframe import PART_I, PART_II, PRINTED_ORIENTATIONS
from .vehicle.parameters import Parameter, Parameters
from .vehicle.rotor import Rotors, hover_speed_squared
from .vehicle.tracker import tracker_bodies, tracker_joints

__version__ = "0.1.0"

__all__ = [
    "GROUND",
    "PART_I",
    "PART_II",
    "PRINTED_ORIENTATIONS",
    "SCENES",
    "Accelerations",
    "AppliedForce",
    "AppliedMoment",
    "Assembly",
    "Augmented",
    "Baumgarte",
    "Body",
    "Certificate",
    "Energy",
    "Evaluation",
    "Gravity",
    "Joint",
    "JointDamping",
    "Kinematics",
    "LinearActuator",
    "LinearSpringDamper",
    "Load",
    "Method",
    "ModelError",
    "Parameter",
    "Parameters",
    "Projection",
    "Rank",
    "Reactions",
    "Rotors",
    "Run",
    "Scene",
    "SettingError",
    "SimulationError",
    "Sine",
    "State",
    "StateError",
    "System",
    "TorsionalSpringDamper",
    "Trajectory",
    "Unstabilised",
    "angular_velocity",
    "assemble",
    "conjugate",
    "cylindrical",
    "distance",
    "drive",
    "energy",
    "euler_parameter_rate",
    "evaluate",
    "from_matrix",
    "from_rotation_vector",
    "hover_speed_squared",
    "integrate",
    "joint_reactions",
    "kvaerno3",
    "kvaerno5",
    "make_scene",
    "matrix_g",
    "matrix_l",
    "momentum",
    "normalise",
    "product",
    "rank",
    "revolute",
    "revolute_spherical",
    "rotation_matrix",
    "simulate",
    "skew",
    "spherical",
    "spin_exact",
    "states_at",
    "to_rotation_vector",
    "tracker_bodies",
    "tracker_joints",
    "translational",
    "universal",
    "weld",
]
