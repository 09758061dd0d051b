"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .day import (
    DAY_FIGURES as DAY_FIGURES,
    day_rows as day_rows,
    light as light,
    load_attitude as load_attitude,
    sky as sky,
    tracking as tracking,
)
from .estimate import (
    CASE_FIGURES as CASE_FIGURES,
    consistency as consistency,
    errors as errors,
    offset as offset,
    rates as rates,
    summary_table as summary_table,
)
from .films import (
    film as film,
)
from .flight_log import (
    FLIGHT_LOG_FIGURES as FLIGHT_LOG_FIGURES,
    IdentifiedFlight as IdentifiedFlight,
    draw_filtered_centre as draw_filtered_centre,
)
from .page import (
    RunPage as RunPage,
    view as view,
)
from .plot import (
    STYLES as STYLES,
    grid as grid,
    look as look,
    save_figures as save_figures,
)
from .posture_survey import (
    effort_histories as effort_histories,
    survey_map as survey_map,
)
from .report import (
    write_report as write_report,
)
from .run import (
    FIGURES as FIGURES,
    balances as balances,
    joints as joints,
    loads_figure as loads_figure,
    pose as pose,
    positions as positions,
    save_loads as save_loads,
)
from .shapes import (
    Shape as Shape,
)
from .sketch import (
    draw as draw,
)
from .study_data import (
    Analysis as Analysis,
    StudyData as StudyData,
    analyse as analyse,
)
from .terminal import (
    certificate_rows as certificate_rows,
    certificate_table as certificate_table,
    loads_table as loads_table,
)
from .tuning import (
    flight_figure as flight_figure,
    load_search as load_search,
    loss_history as loss_history,
    save_linear as save_linear,
    save_search as save_search,
    tuned_curves as tuned_curves,
)
