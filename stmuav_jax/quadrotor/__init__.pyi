"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .assess import (
    CaseStudy as CaseStudy,
    estimate_case as estimate_case,
    study_case as study_case,
    summarise as summarise,
)
from .attitude import (
    attitude_model as attitude_model,
    attitude_space as attitude_space,
)
from .cases import (
    World as World,
    simulate_case as simulate_case,
)
from .extended import (
    extended_model as extended_model,
    extended_noise as extended_noise,
    inertia_matrix as inertia_matrix,
    inertia_states as inertia_states,
)
from .filter_verdict import (
    RunsVerdict as RunsVerdict,
    Verdict as Verdict,
    over_runs as over_runs,
    verdict as verdict,
    verdicts as verdicts,
)
from .hover import (
    Loop as Loop,
    hover_model as hover_model,
    simulate_hover as simulate_hover,
)
from .model import (
    PART_III as PART_III,
    observable_model as observable_model,
    report_model as report_model,
    report_prior as report_prior,
    thrusts as thrusts,
)
from .tuning import (
    FilterTuning as FilterTuning,
    consistent_tuning as consistent_tuning,
    report_tuning as report_tuning,
)
