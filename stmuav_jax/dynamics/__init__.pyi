"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .assembly.initial import (
    Assembly as Assembly,
    Rank as Rank,
    assemble as assemble,
    rank as rank,
    ranks as ranks,
)
from .assembly.joint_start import (
    state_from_joints as state_from_joints,
)
from .assembly.prescribed import (
    KinematicPath as KinematicPath,
    PathReason as PathReason,
    driven as driven,
    driver_efforts as driver_efforts,
    kinematic_path as kinematic_path,
)
from .conserved import (
    Energy as Energy,
    energy as energy,
    momentum as momentum,
)
from .evaluation import (
    Evaluation as Evaluation,
    evaluate as evaluate,
)
from .formulations.augmented import (
    Augmented as Augmented,
)
from .formulations.base import (
    AbstractFormulation as AbstractFormulation,
    AbstractModel as AbstractModel,
    Accelerations as Accelerations,
    Reactions as Reactions,
)
from .formulations.reactions import (
    joint_reactions as joint_reactions,
    reaction_on as reaction_on,
)
from .formulations.stabilisation import (
    AbstractStabilisation as AbstractStabilisation,
    Baumgarte as Baumgarte,
    Projection as Projection,
    Unstabilised as Unstabilised,
)
from .inspection import (
    Finding as Finding,
    Inspection as Inspection,
    check as check,
)
from .integration.adjoint import DiscreteAdjoint as DiscreteAdjoint
from .integration.advance import (
    Trajectory as Trajectory,
)
from .integration.explicit import RungeKutta4 as RungeKutta4
from .integration.rosenbrock import (
    Rodas5P as Rodas5P,
)
from .integration.stepping import (
    kvaerno3 as kvaerno3,
    kvaerno5 as kvaerno5,
)
from .interpolation import (
    states_at as states_at,
)
from .loads import (
    Envelope as Envelope,
    JointLoads as JointLoads,
    envelope as envelope,
    joint_loads as joint_loads,
    resolved_loads as resolved_loads,
    run_loads as run_loads,
    smooth_peaks as smooth_peaks,
)
from .method import (
    Method as Method,
)
from .run import (
    Certificate as Certificate,
    Run as Run,
)
from .scene import (
    Scene as Scene,
)
from .simulation import (
    simulate as simulate,
)
from .statespace.base import (
    AbstractStateSpace as AbstractStateSpace,
    error_rates as error_rates,
)
from .statespace.tree import (
    TreePoint as TreePoint,
    TreeSpace as TreeSpace,
)
from .stiffness import (
    choose_solver as choose_solver,
    spectrum as spectrum,
)
from .trajectory import (
    integrate as integrate,
)
from .tree.formulation import (
    Tree as Tree,
)
from .tree.topology import (
    SpanningTree as SpanningTree,
    spanning_tree as spanning_tree,
)
