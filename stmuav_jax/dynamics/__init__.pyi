"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .assembly.initial import Assembly as Assembly, assemble as assemble
from .assembly.joint_start import (
    state_from_joints as state_from_joints,
)
from .assembly.prescribed import (
    KinematicPath as KinematicPath,
    PathReason as PathReason,
    add_drivers as add_drivers,
    driver_efforts as driver_efforts,
    kinematic_path as kinematic_path,
)
from .assembly.rank import Rank as Rank, rank as rank, ranks as ranks
from .diagnostics import (
    Certificate as Certificate,
)
from .evaluation import (
    Energy as Energy,
    Evaluation as Evaluation,
    energy as energy,
    evaluate as evaluate,
    momentum as momentum,
)
from .formulations.augmented import (
    Augmented as Augmented,
)
from .formulations.base import (
    AbstractFormulation as AbstractFormulation,
    AbstractModel as AbstractModel,
    Accelerations as Accelerations,
    Reactions as Reactions,
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
from .integration.advance import (
    Trajectory as Trajectory,
)
from .integration.solvers import (
    RungeKutta4 as RungeKutta4,
)
from .integration.stepping import (
    kvaerno3 as kvaerno3,
    kvaerno5 as kvaerno5,
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
    DiscreteAdjoint as DiscreteAdjoint,
    Method as Method,
    choose_solver as choose_solver,
    spectrum as spectrum,
)
from .simulation import (
    Run as Run,
    Scene as Scene,
    describe_result as describe_result,
    integrate as integrate,
    simulate as simulate,
    states_at as states_at,
)
from .statespace.base import (
    AbstractStateSpace as AbstractStateSpace,
)
from .statespace.tree import (
    TreePoint as TreePoint,
    TreeSpace as TreeSpace,
)
from .tree.formulation import (
    Tree as Tree,
)
from .tree.topology import (
    SpanningTree as SpanningTree,
    spanning_tree as spanning_tree,
)
