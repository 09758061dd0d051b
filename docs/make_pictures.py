"""Make the pictures of the README and of docs/viewer.md, and the numbers that stand beside them.

python docs/make_pictures.py             # sketches of the models, some seconds each
python docs/make_pictures.py flight      # the flight, its film, and the printed equations, some minutes
"""

import json
import sys
import textwrap
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpec

import stmuav_jax as stm

FOLDER = Path(__file__).parent
FIGURES = FOLDER / "figures"
MODELS = (
    "pendulum", "cart_pole", "four_bar", "slider_crank", "gyroscope", "stewart_platform",
    "delta_robot", "bricard", "quadrotor_slung_load", "tracker",
)  # fmt: skip
# Models whose sketches alone are in the README, where two are side by side on a wide window.
OF_README = ("stewart_platform", "delta_robot", "tracker")
# The time [s] at which the controlled flight is drawn, and the end of the runs beside it.
SHOWN, END = 9.5, 1.0


def sketch_alone(figure: Figure, title: str) -> Figure:
    """Figure of `stm.draw` with its sketch alone, without the graph of the joints."""
    figure.delaxes(figure.axes[1])
    figure.set_size_inches(5.0, 4.6)
    figure.axes[0].set_subplotspec(GridSpec(1, 1, figure=figure)[0])
    figure.axes[0].set_title("")
    figure.suptitle(title, fontsize=11)
    return figure


def stacked(figure: Figure) -> Figure:
    """Figure of `stm.draw` with the graph below the sketch, so that words are legible on a narrow window."""
    figure.set_size_inches(5.0, 8.6)
    figure.suptitle(textwrap.fill(figure.get_suptitle(), 50), fontsize=11)
    places = GridSpec(2, 1, figure=figure)
    for k, axes in enumerate(figure.axes):
        axes.set_subplotspec(places[k])
    return figure


def gallery() -> None:
    """Sketches of all models of docs/models, alone and with the graphs of their joints."""
    for name in MODELS:
        scene = stm.io.load_model(FOLDER / "models" / f"{name}.toml")
        figure = stacked(stm.draw(scene))
        stm.figures.save_figures({name: figure}, FIGURES / "gallery", "png", dpi=90)
        if name in OF_README:
            title = scene.title if name != "tracker" else "Solar tracker"
            sketch = {f"{name}_sketch": sketch_alone(figure, title)}
            stm.figures.save_figures(sketch, FIGURES / "gallery", "png", dpi=90)
        print(name)
    figure = stacked(stm.draw(stm.make_scene("uav_tracker", 2)))
    stm.figures.save_figures({"mechanism": figure}, FIGURES / "viewer", "png", dpi=90)


def state_at(data, k: int) -> stm.State:
    """State of all bodies at one saved time of a dataset."""
    names = ("position", "euler_parameters", "velocity", "angular_velocity")
    return stm.State(*(jnp.asarray(data[name].values[k]) for name in names))


def flight() -> dict[str, float]:
    """The mission "waypoints": its sketch, its panel angles, its moving page; returns its numbers."""
    mission = stm.missions.load_mission("waypoints")
    flown = stm.missions.fly(mission)
    data = stm.missions.to_data(flown)
    scene = stm.make_scene("uav_tracker")
    k = int(np.argmin(np.abs(data.time.values - SHOWN)))
    curves = stm.missions.flight_figures(data)
    drawn = {
        "controlled": sketch_alone(
            stm.draw(scene, state_at(data, k)), f"under control, {data.time.values[k]:.1f} s"
        ),
        "panel": curves["panel"],
    }
    stm.figures.save_figures(drawn, FIGURES / "flight", "png", dpi=90)
    # the page moves at 25 pictures a second
    stm.view(data.isel(time=slice(None, None, 16))).save(FIGURES / "flight" / "waypoints.html")
    stm.film(data, FIGURES / "flight" / "waypoints.gif", fps=12.5, size=(480, 360), speed=2.5)
    degree = np.pi / 180
    return {
        "waypoints_end_s": float(data.time.values[-1]),
        "waypoints_largest_position_error_m": float(
            np.max(np.linalg.norm(data.position_error.values, axis=-1))
        ),
        "waypoints_largest_panel_error_deg": float(np.max(data.panel_error.values) / degree),
        "waypoints_largest_tilt_error_deg": float(np.max(data.tilt_error.values) / degree),
    }


def printed() -> dict[str, float]:
    """Case 2 by the report's method, as printed and as corrected; returns when it stops."""
    sys.path.append(str(FOLDER.parent / "benchmarks"))
    from dense.steps import Scheme  # pyright: ignore
    from dense.system import attempt  # pyright: ignore
    from dense.tables import Variant  # pyright: ignore

    scene = stm.make_scene("uav_tracker", 2)
    times = np.linspace(0.0, END, 1001)
    as_printed = Variant(
        lost_dots=True, transposed_gamma=True, transposed_jacobian=True, shared_index=True
    )
    tight = Scheme("ode45", 1e-6, 1e-9)
    runs = {"as printed": attempt(scene, times, tight, as_printed)}
    runs["corrected"] = attempt(scene, times, tight)
    figure, axes = stm.figures.grid(1, 1, 3.4)
    for (name, (model, run)), (color, dash) in zip(
        runs.items(), (stm.figures.STYLES[1], stm.figures.STYLES[0]), strict=True
    ):
        kept = np.isfinite(run.states).all(axis=1)
        off = [model.violation(state) for state in run.states[kept]]
        axes[0, 0].semilogy(times[: len(off)], np.maximum(off, 1e-12), color=color, linestyle=dash,
                            label=name)  # fmt: skip
    axes[0, 0].set_xlabel("time [s]", fontsize=9)
    axes[0, 0].set_ylabel("largest violation of a constraint [m, 1]", fontsize=9)
    axes[0, 0].legend(fontsize=9)
    figure.suptitle("The report's method, case 2", fontsize=11)
    model, run = runs["as printed"]
    kept = run.states[np.isfinite(run.states).all(axis=1)]
    q = jnp.asarray(model.split(kept[-1])[0][:-1])
    torn = stm.State(q[:, :3], q[:, 3:], scene.state0.v, scene.state0.omega)
    words = f"as printed, {times[len(kept) - 1]:.2f} s: the joints are apart"
    drawn = {"torn": sketch_alone(stm.draw(scene, torn), words), "violation": figure}
    stm.figures.save_figures(drawn, FIGURES / "flight", "png", dpi=90)
    return {f"{name.replace(' ', '_')}_stops_s": float(run.stopped_at)
            for name, (_, run) in runs.items()}  # fmt: skip


def main() -> None:
    if sys.argv[1:] != ["flight"]:
        gallery()
        return
    numbers = printed() | flight()
    text = json.dumps(numbers, indent=1) + "\n"
    (FIGURES / "flight" / "numbers.json").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
