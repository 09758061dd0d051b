"""The names at the root; `__init__.py` imports each when it is first used.

All else is in the sub-namespaces, which have lists like this one.
"""

from . import (
    analysis as analysis,
    control as control,
    dynamics as dynamics,
    estimation as estimation,
    figures as figures,
    io as io,
    math as math,
    mechanics as mechanics,
    missions as missions,
    studies as studies,
    uav as uav,
)
from .analysis.equilibrium import (
    trim as trim,
)
from .analysis.linear import (
    linearize as linearize,
)
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
from .dynamics.method import (
    Method as Method,
)
from .dynamics.simulation import (
    Run as Run,
    Scene as Scene,
    integrate as integrate,
    simulate as simulate,
)
from .dynamics.statespace.tree import (
    TreeSpace as TreeSpace,
)
from .dynamics.tree.formulation import (
    Tree as Tree,
)
from .figures.films import (
    film as film,
)
from .figures.page import (
    view as view,
)
from .figures.sketch import (
    draw as draw,
)
from .io.netcdf import (
    load as load,
)
from .io.run_file import (
    save as save,
)
from .math import (
    rotation as rotation,
)
from .mechanics.body import (
    GROUND as GROUND,
    Body as Body,
)
from .mechanics.forces import (
    AppliedForce as AppliedForce,
    AppliedMoment as AppliedMoment,
    Gravity as Gravity,
    JointDamping as JointDamping,
    LinearSpringDamper as LinearSpringDamper,
    TorsionalSpringDamper as TorsionalSpringDamper,
)
from .mechanics.inputs import (
    inputs_of as inputs_of,
)
from .mechanics.joint import (
    Joint as Joint,
    cylindrical as cylindrical,
    distance as distance,
    drive as drive,
    mimic as mimic,
    revolute as revolute,
    revolute_spherical as revolute_spherical,
    screw as screw,
    spherical as spherical,
    translational as translational,
    universal as universal,
    weld as weld,
)
from .mechanics.joint_forces import (
    JointEffort as JointEffort,
)
from .mechanics.state import (
    State as State,
)
from .mechanics.system import (
    System as System,
)
from .studies.study import (
    Study as Study,
)
from .uav.airframe import (
    PART_I as PART_I,
    PART_II as PART_II,
)
from .uav.scenes.registry import (
    SCENES as SCENES,
    make_scene as make_scene,
)

__version__: str
