"""Command `stmuav identify LOG`: what is in a flight log, and the multirotor that it identifies."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from ..checks.errors import SettingError
from ..figures.terminal import add_row, make_table, print_line
from .models.estimation import UNTRUSTED
from .options import Figures, default_text, shared_option
from .output import print_paths, show_progress
from .scene_options import MODEL_FILES


@dataclasses.dataclass
class IdentifyLog:
    """Identify a multirotor from a flight log of PX4 (ULog), ArduPilot (.BIN), Crazyflie (micro-SD) or CSV.

    Example: stmuav identify log15 --airframe crazyflie.toml. Exit codes: 0 identified, 1 nothing
    identified, 2 wrong input or a log that no identification can pass over, 3 identified, but the verdict is
    inconsistent.
    """

    log: tyro.conf.Positional[Path]
    """The log."""
    airframe: Annotated[Path | None, default_text("the log's own parameters")] = None
    """TOML file with positions [m] and spin of the rotors, in the order of the motors, mass [kg], and what a model
    needs that no flight determines."""
    mass: Annotated[float | None, default_text("the airframe's")] = None
    """Mass of the vehicle [kg]; without one, only ratios are identified."""
    columns: Annotated[Path | None, default_text("names in the header")] = None
    """TOML file with the map of columns of a CSV file."""
    flight: Annotated[int | None, default_text("the longest")] = None
    """Number of the stretch in flight, from 0."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"]), default_text("none")] = None
    """Model file to write, with its mission and study, for check, trim, simulate, fly and montecarlo."""
    out: Annotated[Path | None, shared_option("out"), default_text("no figures")] = None
    figures: Figures = "png"
    list: bool = False
    """Show what is in the log, and stop."""


def is_log(arguments: Sequence[str]) -> bool:
    """Test whether the words after a command name a log: a file that is no model's, or with options of a log."""
    first = arguments[0] if arguments else "--help"
    if first.startswith("--") or first.endswith(MODEL_FILES):
        return False
    return Path(first).is_file() or bool({"--list", "--airframe"} & set(arguments))


def run_identify_log(command: Any) -> int:
    """Run the command; return the exit code."""
    from ..io.flight_log import read_flight_log, read_rotor_layout
    from ..io.netcdf import read_toml
    from ..uav.flight_identification.stages import identify_flight

    out = Console()
    if command.output is not None and command.output.suffix != ".toml":
        raise SettingError(f"A model's file ends in .toml, but --output is {command.output}.")
    if command.out is not None and command.out.exists() and not command.out.is_dir():
        raise SettingError(f"--out must be a folder, but {command.out} is a file.")
    log = read_flight_log(command.log, command.columns)
    if command.list:
        print_line(out, log.describe())
        return 0
    # refusals come as the error
    for note in (note for note in log.notes if note not in log.refusals):
        print_line(out, note)
    record = log.to_record(command.flight)
    layout = log.to_layout() if command.airframe is None else read_rotor_layout(command.airframe)
    if command.airframe is not None and "thrust_model_factor" not in read_toml(command.airframe):
        setting = log.settings.get("thrust_model_factor")
        if setting is not None:
            layout = layout._replace(thrust_model_factor=setting.value)
        source = (
            "it is not given" if setting is None else f"only the log gives it ({setting.source})"
        )
        print_line(out, f"The thrust model factor is {layout.thrust_model_factor:g}, as {source}.")
    if command.mass is not None:
        if not 0 < command.mass < float("inf"):
            raise SettingError(f"The mass must be positive, but it is {command.mass:g} kg.")
        layout = layout._replace(mass=command.mass)
    print_line(out, f"Identifying {record.ts[0]:.1f} to {record.ts[-1]:.1f} s of {log.name}.")
    with show_progress(log.name) as progress:
        result = identify_flight(record, layout, progress=progress)
    estimates = make_table(
        "quantity", "value", "deviation", "blocks", "windows", "variants", "unit", right=1
    )
    for name, e in result.estimates.items():
        parts = (f"{x:.2g}" for x in (e.deviation, e.blocks, e.windows, e.variants))
        add_row(estimates, name.replace("_", " "), f"{e.value:.4g}", *parts, e.unit)
    out.print(estimates)
    for sentence in (*result.refusals.values(), result.verdict.explanation):
        print_line(out, sentence)
    if command.out is not None and command.figures != "none":
        # matplotlib is slow to import: only where figures are drawn
        from ..figures.flight_log import FLIGHT_LOG_FIGURES, IdentifiedFlight
        from ..figures.plot import save_figures

        subject = IdentifiedFlight(log, record, result)
        print_paths(out, save_figures(FLIGHT_LOG_FIGURES, command.out, command.figures, subject))
    if not result.estimates:
        return 1
    if command.output is not None:
        from ..io.identified_model import write_identified_model

        *paths, notes = write_identified_model(result, command.output, source=log.name)
        for note in notes:
            print_line(out, note)
        print_paths(out, paths)
    return UNTRUSTED if result.verdict.status == "inconsistent" else 0
