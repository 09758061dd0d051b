"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .columns import (
    FINE as FINE,
    Axis as Axis,
    Column as Column,
)
from .distribution import (
    Distribution as Distribution,
    as_distribution as as_distribution,
)
from .disturbed_flights import (
    Flights as Flights,
    ModelFlights as ModelFlights,
    make_flights as make_flights,
)
from .examples import (
    READY as READY,
    load_builtin_study as load_builtin_study,
)
from .flights import (
    FlightEvaluation as FlightEvaluation,
    make_flight_study as make_flight_study,
)
from .sampling import (
    Sampling as Sampling,
)
from .schema import (
    Failure as Failure,
    Quantity as Quantity,
)
from .sensitivity import (
    SobolIndices as SobolIndices,
    separation as separation,
    sobol as sobol,
    spearman as spearman,
    spline_shares as spline_shares,
)
from .statistics import (
    bands as bands,
    mean as mean,
    outcomes as outcomes,
    probability as probability,
    quantiles as quantiles,
    standard_deviation as standard_deviation,
    summarise as summarise,
)
from .store import (
    Store as Store,
    open_store as open_store,
)
from .study import (
    AbstractBatch as AbstractBatch,
    StudyOutcome as StudyOutcome,
    StudyProgress as StudyProgress,
)
from .study_file import (
    column as column,
    load_study as load_study,
    make_study as make_study,
)
