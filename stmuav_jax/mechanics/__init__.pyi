"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .body import (
    GROUND as GROUND,
    Body as Body,
)
from .forces.applied import (
    AppliedForce as AppliedForce,
    AppliedMoment as AppliedMoment,
    Gravity as Gravity,
    JointDamping as JointDamping,
    LinearSpringDamper as LinearSpringDamper,
    TorsionalSpringDamper as TorsionalSpringDamper,
)
from .forces.contact import (
    GroundContact as GroundContact,
)
from .forces.effort import (
    JointEffort as JointEffort,
)
from .forces.joint import (
    EndStop as EndStop,
    JointFriction as JointFriction,
    JointServo as JointServo,
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
)
from .joint import (
    CATALOGUE as CATALOGUE,
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
from .joint_kind import (
    Freedom as Freedom,
    JointKind as JointKind,
    Term as Term,
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
from .motions.axial import (
    PRISMATIC as PRISMATIC,
    REVOLUTE as REVOLUTE,
    Axial as Axial,
)
from .motions.base import (
    AbstractRelativeMotion as AbstractRelativeMotion,
)
from .motions.spherical import (
    SPHERICAL as SPHERICAL,
)
from .parts import (
    Part as Part,
    box as box,
    compound as compound,
    cylinder as cylinder,
    point_mass as point_mass,
    rod as rod,
    sphere as sphere,
)
from .state import (
    Kinematics as Kinematics,
    State as State,
)
from .system import (
    System as System,
)
