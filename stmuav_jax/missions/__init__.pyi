"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .ensemble import (
    MissionWork as MissionWork,
    mission_work as mission_work,
)
from .figures import (
    FLIGHT_FIGURES as FLIGHT_FIGURES,
    flight_figures as flight_figures,
)
from .flight import (
    MissionFlight as MissionFlight,
    fly as fly,
)
from .mission import (
    Mission as Mission,
    load_mission as load_mission,
    make_mission as make_mission,
    mission_names as mission_names,
)
from .outcome import (
    Measure as Measure,
    measures as measures,
    to_data as to_data,
    verdict as verdict,
)
from .report import write_flight_report as write_flight_report
