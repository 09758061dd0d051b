"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .body import (
    GROUND as GROUND,
    Body as Body,
    Part as Part,
    box as box,
    compound as compound,
    cylinder as cylinder,
    point_mass as point_mass,
    rod as rod,
    sphere as sphere,
)
from .forces import (
    AppliedForce as AppliedForce,
    AppliedMoment as AppliedMoment,
    Gravity as Gravity,
    GroundContact as GroundContact,
    JointDamping as JointDamping,
    LinearSpringDamper as LinearSpringDamper,
    TorsionalSpringDamper as TorsionalSpringDamper,
)
from .inputs import (
    Inputs as Inputs,
    inputs_of as inputs_of,
    with_inputs as with_inputs,
)
from .internal import (
    AbstractInternalForce as AbstractInternalForce,
    internal_names as internal_names,
    with_internal as with_internal,
    with_start_angles as with_start_angles,
)
from .joint import (
    CATALOGUE as CATALOGUE,
    Freedom as Freedom,
    Joint as Joint,
    JointKind as JointKind,
    Term as Term,
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
from .joint_forces import (
    EndStop as EndStop,
    JointEffort as JointEffort,
    JointFriction as JointFriction,
    JointServo as JointServo,
)
from .joint_states import (
    JointMotion as JointMotion,
    joint_motion as joint_motion,
)
from .load import (
    AbstractForce as AbstractForce,
    ActsOn as ActsOn,
    Load as Load,
    Sine as Sine,
    SineMotion as SineMotion,
    push as push,
)
from .motions import (
    PRISMATIC as PRISMATIC,
    REVOLUTE as REVOLUTE,
    SPHERICAL as SPHERICAL,
    AbstractRelativeMotion as AbstractRelativeMotion,
    Axial as Axial,
)
from .parameters import (
    Parameter as Parameter,
    Parameters as Parameters,
)
from .state import (
    Kinematics as Kinematics,
    State as State,
)
from .system import (
    System as System,
)
