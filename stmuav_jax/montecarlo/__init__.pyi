"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .batch import (
    FlightWork as FlightWork,
)
from .distribution import (
    Distribution as Distribution,
    as_distribution as as_distribution,
)
from .disturbed_flights import (
    Flights as Flights,
    flights as flights,
)
from .estimates import (
    EstimationStudy as EstimationStudy,
    EstimationWork as EstimationWork,
)
from .examples import (
    READY as READY,
    make_work as make_work,
    ready as ready,
)
from .model_flights import (
    ModelFlights as ModelFlights,
)
from .sampling import (
    Sampling as Sampling,
    sampling_from_plain as sampling_from_plain,
)
from .sensitivity import (
    SobolIndices as SobolIndices,
    binned as binned,
    separation as separation,
    sobol as sobol,
    spearman as spearman,
)
from .statistics import (
    bands as bands,
    convergence as convergence,
    mean as mean,
    outcomes as outcomes,
    probability as probability,
    quantiles as quantiles,
    standard_deviation as standard_deviation,
    summarise as summarise,
)
from .study import (
    Quantity as Quantity,
    Study as Study,
    study_from_plain as study_from_plain,
)
from .work import (
    AbstractWork as AbstractWork,
    Axis as Axis,
    Column as Column,
)
