"""The names at the root; `__init__.py` imports each when it is first used.

All else is in the sub-namespaces, which have lists like this one.
"""

from . import (
    algebra as algebra,
    control as control,
    dynamics as dynamics,
    environment as environment,
    estimation as estimation,
    figures as figures,
    files as files,
    flight as flight,
    jobs as jobs,
    mechanics as mechanics,
    missions as missions,
    montecarlo as montecarlo,
    parameters as parameters,
    quadrotor as quadrotor,
    rotorcraft as rotorcraft,
    scenes as scenes,
    sensing as sensing,
    tracker as tracker,
    viewer as viewer,
)
from .algebra import rotation as rotation
from .checks.errors import (
    ModelError as ModelError,
    SettingError as SettingError,
    SimulationError as SimulationError,
    StateError as StateError,
)
from .dynamics.assembly.initial import (
    assemble as assemble,
)
from .dynamics.assembly.joint_start import (
    state_from_joints as state_from_joints,
)
from .dynamics.formulations.augmented import (
    Augmented as Augmented,
)
from .dynamics.formulations.stabilisation import (
    Baumgarte as Baumgarte,
    Projection as Projection,
    Unstabilised as Unstabilised,
)
from .dynamics.inspection import (
    check as check,
)
from .dynamics.integration.rosenbrock import (
    Rodas5P as Rodas5P,
)
from .dynamics.method import (
    Method as Method,
)
from .dynamics.run import (
    Run as Run,
)
from .dynamics.scene import (
    Scene as Scene,
)
from .dynamics.simulation import (
    simulate as simulate,
)
from .dynamics.statespace.tree import (
    TreeSpace as TreeSpace,
)
from .dynamics.trajectory import (
    integrate as integrate,
)
from .dynamics.tree.formulation import (
    Tree as Tree,
)
from .files.netcdf import (
    load as load,
    save as save,
)
from .flight.equilibrium import (
    trim as trim,
)
from .flight.linear import (
    linearize as linearize,
)
from .mechanics.body import (
    GROUND as GROUND,
    Body as Body,
)
from .mechanics.forces.applied import (
    AppliedForce as AppliedForce,
    AppliedMoment as AppliedMoment,
    Gravity as Gravity,
    JointDamping as JointDamping,
    LinearSpringDamper as LinearSpringDamper,
    TorsionalSpringDamper as TorsionalSpringDamper,
)
from .mechanics.forces.effort import (
    JointEffort as JointEffort,
)
from .mechanics.inputs import (
    inputs_of as inputs_of,
)
from .mechanics.joint import (
    Joint as Joint,
    cylindrical as cylindrical,
    distance as distance,
    drive as drive,
    revolute as revolute,
    revolute_spherical as revolute_spherical,
    screw as screw,
    spherical as spherical,
    translational as translational,
    universal as universal,
    weld as weld,
)
from .mechanics.state import (
    State as State,
)
from .mechanics.system import (
    System as System,
)
from .parameters.airframe import (
    PART_I as PART_I,
    PART_II as PART_II,
)
from .scenes.registry import (
    SCENES as SCENES,
    make_scene as make_scene,
)
from .viewer.filming import (
    film as film,
)
from .viewer.page import (
    view as view,
)
from .viewer.sketch import (
    draw as draw,
)

__version__: str
