"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .consistency import (
    RunsVerdict as RunsVerdict,
    Verdict as Verdict,
    autocorrelation as autocorrelation,
    inconsistent as inconsistent,
    mean_interval as mean_interval,
    nees as nees,
    over_runs as over_runs,
    path_nees as path_nees,
    verdict as verdict,
    verdicts as verdicts,
)
from .filter import (
    AbstractFilter as AbstractFilter,
    EstimationError as EstimationError,
    Filtered as Filtered,
    GaussianFilter as GaussianFilter,
    Innovation as Innovation,
    filter_bank as filter_bank,
    kalman_filter as kalman_filter,
)
from .gaussians import (
    Gaussian as Gaussian,
    gaussian as gaussian,
)
from .inertial import (
    Belief as Belief,
    strapdown as strapdown,
)
from .likelihood import (
    Tuned as Tuned,
    record_likelihood as record_likelihood,
    standard_errors as standard_errors,
    tune as tune,
)
from .model import (
    Sensor as Sensor,
    StateSpaceModel as StateSpaceModel,
    euler as euler,
    rk4 as rk4,
)
from .observable import (
    Observability as Observability,
    observability as observability,
)
from .online import (
    OnlineEstimate as OnlineEstimate,
    OnlineFilter as OnlineFilter,
)
from .sigma import (
    AbstractRule as AbstractRule,
    Cubature as Cubature,
    Cubature5 as Cubature5,
    Linearised as Linearised,
    Unscented as Unscented,
)
from .smoother import (
    Smoothed as Smoothed,
    smooth as smooth,
)
