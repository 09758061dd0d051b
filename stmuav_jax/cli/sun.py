"""Command `stmuav sun`: a day of pointing the panel at the sun."""

import dataclasses
import math
from pathlib import Path
from typing import Annotated, Any

from rich.console import Console

from ..checks.errors import SettingError
from ..figures.terminal import print_line
from .options import ANGLE, Cache, Figures, Number, Params, default_text, shared_option
from .output import print_paths, results_folder


@dataclasses.dataclass
class SunDay:
    """Point the panel at the sun for a day; write day.nc and figures.

    Example: stmuav sun --lat 11.55 --lon 104.92 --date 2024-03-21 --timezone Asia/Phnom_Penh
    """

    lat: Annotated[float, Number("latitude", "degrees", -90, 90)]
    """Latitude, north positive [degrees]."""
    lon: Annotated[float, Number("longitude", "degrees", -360, 360)]
    """Longitude, east positive [degrees]."""
    date: str
    """Date at the place, such as 2024-03-21."""
    timezone: Annotated[str | None, default_text("whole hours by the longitude")] = None
    """Time zone such as Asia/Phnom_Penh or +07:00."""
    altitude: Annotated[float, Number("altitude", "m", -500, 11000)] = 0.0
    """Altitude of the place above sea level [m]."""
    roll: Annotated[float, ANGLE] = 0.0
    """Angle of the UAV about its x axis [degrees]."""
    pitch: Annotated[float, ANGLE] = 0.0
    """Angle of the UAV about its y axis [degrees]; a positive one lowers the x axis."""
    yaw: Annotated[float | None, ANGLE, shared_option("yaw", "the heading of the most energy")] = (
        None
    )
    attitude: Annotated[Path | None, default_text("a constant attitude")] = None
    """CSV file with a history of the attitude: columns t [s], roll, pitch, yaw [degrees]."""
    step: Annotated[float, Number("time step", "s", 1, 7200)] = 300.0
    """Time between samples [s]."""
    stroke_step: Annotated[float, Number("step of the actuators", "m", 0, 0.05)] = 0.0
    """Smallest step of the linear actuators [m]."""
    attitude_error: Annotated[
        tuple[float, float, float], dataclasses.replace(ANGLE, quantity="error of the attitude")
    ] = (0.0, 0.0, 0.0)
    """Rotation vector from the true attitude to the estimated one, body axes [degrees]."""
    turbidity: Annotated[
        float | None, Number("turbidity", "", 1, 20), default_text("the month's mean at the place")
    ] = None
    """Linke turbidity of the air."""
    params: Params = None
    out: Annotated[Path | None, shared_option("out", "runs/sun_DATE")] = None
    figures: Figures = "png"
    cache: Cache = True


def run_sun(command: SunDay) -> int:
    """Simulate the day, print and write the results; return the exit code."""
    # pvlib and matplotlib are slow to import, and so are imported only here
    import numpy as np

    from ..figures.day import DAY_FIGURES, day_tables, labelled_day, load_attitude
    from ..figures.plot import save_figures
    from ..io.netcdf import load_parameters, save_labelled
    from ..uav.airframe import PART_II
    from ..uav.environment.calendar import day_zone, parse_date
    from ..uav.environment.ephemeris import Place
    from ..uav.environment.sun import attitude
    from ..uav.tracker.day import Imperfections, best_heading, track_day

    if command.attitude is not None and (command.roll or command.pitch or command.yaw is not None):
        raise SettingError(
            "The option --attitude excludes --roll, --pitch and --yaw: give one or the others."
        )
    day_of, zone = parse_date(command.date), day_zone(command.timezone, command.lon)
    place = Place.degrees(command.lat, command.lon, command.altitude)
    settings: dict[str, Any] = {
        "parameters": load_parameters(command.params, PART_II), "turbidity": command.turbidity,
    }  # fmt: skip
    flaws = Imperfections(command.stroke_step, math.radians(1) * np.array(command.attitude_error))
    turn = lambda yaw: attitude(math.radians(command.roll), math.radians(command.pitch), yaw)
    chosen = ""
    if command.attitude is not None:
        R_wb = load_attitude(command.attitude)
    elif command.yaw is not None:
        R_wb = turn(math.radians(command.yaw))
    else:
        yaw = best_heading(place, day_of, zone, turn, **settings)
        chosen = f"Heading chosen for the most energy: --yaw {math.degrees(yaw):g}."
        R_wb = turn(yaw)
    day = track_day(place, day_of, zone, R_wb, step=command.step, flaws=flaws, **settings)
    folder = results_folder(command.out, f"sun_{command.date}")
    paths = [save_labelled(labelled_day(day), folder / "day.nc")]
    if command.figures != "none":
        paths += save_figures(DAY_FIGURES, folder, command.figures, day)
    out = Console()
    for day_table in day_tables(day):
        out.print(day_table)
    if chosen:
        print_line(out, chosen)
    print_paths(out, paths)
    return 0
