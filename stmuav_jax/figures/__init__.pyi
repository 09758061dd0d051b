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
    hover as hover,
    hover_table as hover_table,
    offset as offset,
    rates as rates,
    summary_table as summary_table,
)
from .filter_record import (
    FilterRecord as FilterRecord,
    record_of_dataset as record_of_dataset,
    record_of_file as record_of_file,
)
from .filter_report import write_filter_report as write_filter_report
from .linear import (
    pole_map as pole_map,
    step_response as step_response,
)
from .loads import (
    loads_figure as loads_figure,
    loads_table as loads_table,
    save_loads as save_loads,
)
from .loop_report import write_loop_report as write_loop_report
from .plot import (
    FIGURES as FIGURES,
    STYLES as STYLES,
    balances as balances,
    grid as grid,
    joints as joints,
    look as look,
    pose as pose,
    save_figures as save_figures,
)
from .report import (
    certificate_rows as certificate_rows,
    certificate_table as certificate_table,
)
from .run_report import write_run_report as write_run_report
from .studies.analysis import (
    Analysis as Analysis,
    analyse as analyse,
)
from .studies.data import (
    StudyData as StudyData,
)
from .studies.report import (
    write_report as write_report,
)
from .tuning import (
    flight_figure as flight_figure,
    flown as flown,
    load_search as load_search,
    loss_history as loss_history,
    save_linear as save_linear,
    save_search as save_search,
)
