"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .ensemble import (
    MissionEvaluation as MissionEvaluation,
    load_mission_study as load_mission_study,
    make_mission_study as make_mission_study,
)
from .figures import flight_figures as flight_figures
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
    to_flight_record as to_flight_record,
    verdict as verdict,
)
