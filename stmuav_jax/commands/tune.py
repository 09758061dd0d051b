"""Command `stmuav tune`: hold still, turn the panel, or identify parameters from a record."""

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro
from rich.table import Table

from ..checks.errors import SettingError
from ..figures.terminal import row, table
from .flight import table_of
from .models.searching import HOLDS, What, converged, ended, loss_figures, watched
from .models.tuning import ABOUT, WHAT, TuneSettings, run_tune_scene
from .options import ANGLE, END, FORCE, Cache, Figures, Number, Resume, Seed, count, default, shared
from .output import results_folder
from .simulate import command_or_scene

if TYPE_CHECKING:
    from ..algebra.least_squares import Search
    from ..flight.tuning import InputTuning
    from ..parameters.table import Parameters


SEGMENTS = "hold: one in 0.05 s, slew: one in 0.2 s"
# Times over which departures count, and of the turn [s], and longest segments of both [s]. From
# rest an untuned UAV falls far within 0.2 s: with segments so long the search does not converge.
_TIMES = {"hold": 0.4, "slew": 1.0}
_LONGEST = {"hold": 0.05, "slew": 0.2}


@dataclasses.dataclass
class Tune:
    """Tune by gradients through the flight; write inputs or parameters, history and figures.

    Example: stmuav tune hold --t1 0.4; stmuav tune slew --to 8 0. The UAV begins with equal rotor speeds and idle
    actuators; identify simulates its own record, with noise. The inputs of another mechanism are tuned by `stmuav
    tune hold model.toml`, or by a scene's name; `stmuav tune hold model.toml --help` describes that. A search that
    does not converge ends with exit code 1.
    """

    what: Annotated[tyro.conf.Positional[What], shared("what")]
    to: Annotated[tuple[float, float], ANGLE] = (8.0, 0.0)
    """slew: panel angles at the end [degrees]; at the start they are the initial ones."""
    t1: Annotated[float | None, END, shared("duration"), default("hold 0.4, slew 1")] = None
    force: Annotated[float | None, FORCE, default("none")] = None
    """slew: largest force of the actuators, either way [N]."""
    reaction: Annotated[float | None, FORCE, default("none")] = None
    """slew: largest reaction force in any joint [N]."""
    segments: Annotated[
        int | None, count("segments", 1000), shared("segments"), default(SEGMENTS)
    ] = None
    knots: Annotated[int, Number("number of knots", "", 4, 200), shared("knots")] = 8
    seed: Seed = 0
    steps: Annotated[int, count("steps", 1e6), shared("steps")] = 60
    resume: Resume = False
    params: Annotated[Path | None, shared("params"), default("the report's values")] = None
    out: Annotated[Path | None, shared("out"), default("runs/tune_WHAT")] = None
    figures: Figures = "png"
    cache: Cache = True


def _search(command: Tune, folder: Path, tuning: "InputTuning") -> "Search":
    run = lambda **options: tuning.search(patience=15, **options)
    return watched(command, folder, tuning.name, tuning.start, run)


tune_options = command_or_scene(Tune, "TuneScene", TuneSettings, ABOUT, WHAT)


def run_tune(command: Any) -> int:
    """Run the command; return the exit code."""
    if not isinstance(command, Tune):
        return run_tune_scene(command)
    given = table_of(command.params)
    folder = results_folder(command.out, f"tune_{command.what}")
    if command.what != "slew" and (command.force is not None or command.reaction is not None):
        raise SettingError("--force and --reaction are limits of a slew.")
    work = {"hold": _hold, "slew": _slew, "identify": _identify}[command.what]
    found, shown, paths, done = work(command, given, folder)
    words = (
        f"what it has reached is in {folder}. Continue with --resume --steps {found.steps + 60}, or "
        "try other --segments."
    )
    return ended(found, shown, folder, paths, done, words)


def _time(command: Tune) -> float:
    return command.t1 if command.t1 is not None else _TIMES[command.what]


def _segments(command: Tune) -> int:
    if command.segments is not None:
        return command.segments
    # the quotient may exceed a whole number by round-off, as 0.3 / 0.05
    return max(1, math.ceil(_time(command) / _LONGEST[command.what] - 1e-9))


def titled(title: str, found: "Search", done: bool) -> str:
    """Title of a table of results; it says so where the search has not converged."""
    if done:
        return title
    return f"NOT CONVERGED: the best of {found.steps} steps ({title.lower()})"


def _hold(
    command: Tune, given: "Parameters", folder: Path
) -> tuple["Search", Table, list[Path], bool]:
    from ..checks.numbers import as_numpy, floats
    from ..flight.flyer import RotorsAndForces, rotors_and_forces
    from ..flight.uav_tuning import at_rest, hold, holding_time
    from ..rotorcraft.rotor import hover_speed_squared
    from ..scenes.uav_tracker import uav_flyer
    from ..tracker.geometry import initial_angles

    flyer = uav_flyer(given)
    rotors = flyer.propellers
    mass = np.sum(as_numpy(flyer.system.bodies.mass))
    count = rotors.spin.shape[0]
    equal = hover_speed_squared(mass, given.value("gravity"), rotors.k_f, count)
    untuned = RotorsAndForces(equal, floats(np.zeros(2)))
    angles = initial_angles(given)
    tuning = hold(flyer, angles, untuned, horizon=_time(command), segments=_segments(command))
    found = _search(command, folder, tuning)
    # a search may come to rest where nothing holds
    done = converged(found) and found.loss < HOLDS
    values = np.asarray(tuning.inputs(found.values))
    inputs = RotorsAndForces(*(floats(part) for part in rotors_and_forces(values)))
    start = at_rest(angles)
    times = [holding_time(flyer, each, start) for each in (untuned, inputs)]
    untuned, inputs = as_numpy((untuned, inputs))
    shown = table("", "untuned", "tuned", title=titled("Constant inputs that hold", found, done))
    for k in range(count):
        pair = (untuned.speed_squared[k], inputs.speed_squared[k])
        row(shown, f"rotor {k + 1} [rad/s]", *(_speed(float(x)) for x in pair))
    for k in range(2):
        pair = (untuned.forces[k], inputs.forces[k])
        row(shown, f"actuator {k + 2} [N]", *(f"{float(x):.6f}" for x in pair))
    row(shown, "within 5 degrees until [s]", *(f"{t:.3f}" for t in times))
    return found, shown, loss_figures(found, folder, command.figures), done


def _speed(squared: float) -> str:
    # an unfinished search may still have negative squares
    return f"{math.sqrt(squared):.4f}" if squared >= 0 else f"none: square {squared:.3g}"


def _slew(
    command: Tune, given: "Parameters", folder: Path
) -> tuple["Search", Table, list[Path], bool]:
    from ..figures.tuning import flight_figure, flown
    from ..flight.uav_tuning import SlewLimits, peaks, slew
    from ..scenes.uav_tracker import uav_flyer
    from ..tracker.geometry import initial_angles
    from ..tracker.workspace import tracker_limits

    flyer = uav_flyer(given)
    stops = tracker_limits(given)
    force = math.inf if command.force is None else command.force
    limits = SlewLimits(force, stops.home, stops.lower, stops.upper, command.reaction)
    after = np.radians(command.to)
    tuning = slew(
        flyer, initial_angles(given), after, _time(command), limits,
        knots=command.knots, segments=_segments(command),
    )  # fmt: skip
    found = _search(command, folder, tuning)
    done = converged(found)
    shown = table(
        "", "straight inputs", "tuned", "limit", title=titled("Turn of the panel", found, done)
    )
    each = [peaks(tuning, values) for values in (tuning.start, found.values)]
    mm = lambda x: ", ".join(f"{1e3 * float(v):.1f}" for v in x)
    rows: list[tuple[str, Any, str]] = [
        ("error at the end [mrad]", lambda p: f"{1e3 * float(p.error):.3f}", ""),
        ("largest tilt [mrad]", lambda p: f"{1e3 * float(p.tilt):.2f}", ""),
        ("largest drift [mm]", lambda p: f"{1e3 * float(p.drift):.2f}", ""),
        ("force [N]", lambda p: f"{float(p.force):.3f}", f"{limits.force}"),
        ("smallest displacements [mm]", lambda p: mm(p.lower), mm(limits.lower)),
        ("largest displacements [mm]", lambda p: mm(p.upper), mm(limits.upper)),
    ]
    if command.reaction is not None:
        rows.append(("reaction [N]", lambda p: f"{float(p.reaction):.2f}", f"{command.reaction}"))
    for label, of, limit in rows:
        row(shown, label, *(of(p) for p in each), limit)
    ts, curves = flown(tuning, found.values)
    marks = {"actuators [N]": [-command.force, command.force]} if command.force else {}
    more = {"flight": flight_figure(ts, curves, marks)}
    figures = loss_figures(found, folder, command.figures, more)
    return found, shown, figures, done


def _identify(
    command: Tune, given: "Parameters", folder: Path
) -> tuple["Search", Table, list[Path], bool]:
    import jax.numpy as jnp
    from scipy.stats import chi2

    from ..algebra.least_squares import SearchReason
    from ..flight.identification import identify
    from ..flight.synthetic import experiment
    from ..scenes.uav_tracker import uav_flyer
    from ..tracker.tracker_options import Friction

    make = lambda table: uav_flyer(table, friction=Friction())
    case = experiment(make, given, seed=command.seed)
    run = lambda **options: identify(
        case.predict, case.record, case.sigma, case.start, case.sizes,
        labels=case.labels, min_singular_value=0.5, **options,
    )  # fmt: skip
    found = watched(command, folder, f"identify {case.name}", jnp.zeros(len(case.truth)), run)
    # at the level of the noise a search may stop improving without convergence
    freedom = case.record.size - len(case.truth)
    stopped = found.search.reason is SearchReason.PATIENCE
    noise = stopped and found.reduced_chi_square * freedom <= chi2.ppf(0.999, freedom)
    done = converged(found.search) or bool(noise)
    shown = table(
        "parameter", "true", "start", "found", "deviation",
        title=titled("Identified parameters", found.search, done),
    )  # fmt: skip
    for k, label in enumerate(case.labels):
        numbers = (case.truth[k], case.start[k], found.values[k], found.standard_deviations[k])
        row(shown, label, *(f"{x:.5g}" for x in numbers))
    return found.search, shown, loss_figures(found.search, folder, command.figures), done
