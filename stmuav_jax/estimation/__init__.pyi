"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .bank import (
    filter_bank as filter_bank,
)
from .consistency import (
    autocorrelation as autocorrelation,
    chi2_interval as chi2_interval,
    inconsistent as inconsistent,
    mean_interval as mean_interval,
    nees as nees,
    path_nees as path_nees,
)
from .filter import (
    EstimationError as EstimationError,
    Filtered as Filtered,
    kalman_filter as kalman_filter,
)
from .gaussians import (
    Gaussian as Gaussian,
    gaussian as gaussian,
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
)
from .observable import (
    Observability as Observability,
    observability as observability,
)
from .online import (
    OnlineEstimate as OnlineEstimate,
    OnlineFilter as OnlineFilter,
)
from .propagate import (
    euler as euler,
    rk4 as rk4,
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
from .update import (
    AbstractFilter as AbstractFilter,
    GaussianFilter as GaussianFilter,
    Innovation as Innovation,
    ReusingFilter as ReusingFilter,
)
