"""Make the figures and the accuracy table of docs/report_items.md from fresh runs; some minutes.

python docs/make_report.py                      # everything
python docs/make_report.py rotations thrusts    # parts of it, see PARTS
"""

import re
import sys
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure
from matplotlib.patches import Patch

import stmuav_jax as stm
from stmuav_jax.figures import FIGURES, STYLES, grid, positions, save_figures
from stmuav_jax.uav import Reason, panel_angles, survey, tracker_geometry, tracker_limits

FOLDER = Path(__file__).parent
OUT = FOLDER / "figures" / "report"
HEAD = """| scene | case | position error | grows e-fold every | violation, lengths | angles \
| relative energy error | steps |
|---|---|---|---|---|---|---|---|
"""


def save(drawn: dict[str, Figure]) -> None:
    """Save figures of the page at its resolution."""
    save_figures(drawn, OUT, "png", dpi=110)


def cases() -> None:
    """Runs of the six cases of Parts I and II: positions, strokes and panel angles, and the table."""
    rows, panel = "", []
    for name, bodies in (
        ("tracker", ("slider_2", "slider_3", "panel_7")),
        ("uav_tracker", ("hexacopter_1", "slider_2", "slider_3", "panel_7")),
    ):
        for case in (1, 2, 3):
            run = stm.simulate(stm.make_scene(name, case))
            c = run.certificate
            growth = "-" if c.error_e_folding_time is None else f"{c.error_e_folding_time:.2g} s"
            rows += (
                f"| `{name}` | {case} | {c.position_error:.1e} m | {growth} "
                f"| {c.position_violation:.1e} m | {c.angle_violation:.1e} rad "
                f"| {c.relative_energy_error:.1e} | {c.accepted_steps} |\n"
            )
            save({f"{run.scene.name}_positions": positions(run, bodies, detail=0.5)})
            joints = FIGURES["joints"](run)
            save({f"{run.scene.name}_joints": joints})
            if name == "tracker":
                panel.append((case, joints.axes[-1]))
            print(run.scene.name, c.result)
    figure, axes = grid(3, 1, 5.6, sharex=True)
    for ax, (case, drawn) in zip(axes[:, 0], panel, strict=True):
        for line, (color, dash) in zip(drawn.lines, STYLES, strict=False):
            ax.plot(*line.get_data(), color=color, linestyle=dash, label=line.get_label())
        ax.set_ylabel(f"case {case}\n{drawn.get_ylabel()}", fontsize=9)
    axes[0, 0].legend(fontsize=9)
    axes[-1, 0].set_xlabel("time [s]", fontsize=9)
    figure.suptitle("Part I: orientation of the solar panel", fontsize=10)
    save({"panel_orientation": figure})
    page = FOLDER / "report_items.md"
    text = page.read_text(encoding="utf-8")
    text = re.sub(r"\| scene \| case \|.*?\n\n", lambda _: HEAD + rows + "\n", text, flags=re.S)
    page.write_text(text, encoding="utf-8")


def ball_joint() -> None:
    """Two bodies on a ball joint: Euler parameters, and their difference from the closed form (Eq. 4.28)."""
    run = stm.simulate(stm.make_scene("spin"))
    table = stm.PART_I.value
    phi = (
        0.5 * float(table("spin.moment")) / float(np.asarray(table("spin.inertia"))[2]) * run.ts**2
    )
    p = np.asarray(run.states.p)[:, 0]
    exact = np.stack([np.cos(phi / 2), np.sin(phi / 2)], axis=1)
    error = np.abs(p[:, [0, 3]] - exact)
    figure, axes = grid(2, 1, 4.2, sharex=True)
    for k, label in enumerate(("$e_0$", "$e_3$")):
        color, dash = STYLES[k]
        axes[0, 0].plot(run.ts, p[:, (0, 3)[k]], color=color, linestyle=dash, label=label)
        axes[1, 0].semilogy(run.ts, np.where(error[:, k] > 0, error[:, k], np.nan), color=color,
                            linestyle=dash, label=label)  # fmt: skip
    axes[0, 0].set_ylabel("Euler parameter [1]", fontsize=9)
    axes[1, 0].set_ylabel("error [1]", fontsize=9)
    axes[1, 0].set_xlabel("time [s]", fontsize=9)
    axes[1, 0].set_ylim(1e-17, 1e-13)
    axes[0, 0].legend(fontsize=9, loc="lower left")
    figure.suptitle(
        f"Two bodies on a ball joint: largest error {error.max():.1e}; the report states 1e-9",
        fontsize=10,
    )
    save({"ball_joint": figure})
    print("ball joint", error.max())


def hexacopter() -> None:
    """Hexacopter alone: its rotors seen from above, and its position (Part II, Fig. 4.1, 4.2, 5.2)."""
    scene = stm.make_scene("hexacopter")
    run = stm.simulate(scene)
    save({"hexacopter_positions": positions(run, ["hexacopter"], detail=0.5)})
    arms, spin = (np.asarray(stm.PART_II.value(f"rotor.{name}")) for name in ("arms", "spin"))
    figure, axes = grid(1, 1, 4.4)
    ax = axes[0, 0]
    for k, (arm, sign) in enumerate(zip(arms, spin, strict=True), 1):
        color = STYLES[0 if sign > 0 else 1][0]
        ax.plot([0, arm[0]], [0, arm[1]], color="0.5", linewidth=2, zorder=1)
        angle = np.linspace(0, 2 * np.pi, 60)
        ax.fill(arm[0] + 0.1 * np.cos(angle), arm[1] + 0.1 * np.sin(angle), color=color, alpha=0.25)
        ax.text(*arm[:2], f"{k}, {'+' if sign > 0 else '-'}", ha="center", va="center", fontsize=10,
                bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0})  # fmt: skip
    for axis, (x, y) in (("x", (0.12, 0.0)), ("y", (0.0, 0.12))):
        ax.annotate("", (x, y), (0, 0), arrowprops={"arrowstyle": "->", "color": "black"})
        ax.text(1.15 * x, 1.15 * y, axis, fontsize=10, ha="center", va="center")
    ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    figure.suptitle(
        "Rotors of Table 5.2 from above; sign: drag moment about z of each", fontsize=10
    )
    save({"hexacopter_rotors": figure})


def rotations() -> None:
    """Elementary rotations by 30 degrees, and the rotation formula (Part II, Fig. 6.1 to 6.4)."""
    angle = np.pi / 6
    figure = Figure(figsize=(7.0, 7.2), layout="constrained")
    names = (("x", "roll"), ("y", "pitch"), ("z", "yaw"))
    for k, (axis, word) in enumerate(names):
        ax = figure.add_subplot(2, 2, k + 1, projection="3d")
        R = np.asarray(
            stm.rotation.rotation_matrix(stm.rotation.from_rotation_vector(angle * jnp.eye(3)[k]))
        )
        for column in range(3):
            for end, dash, mark in ((np.eye(3)[:, column], "-", ""), (R[:, column], "--", "'")):
                color = STYLES[column][0]
                ax.plot(
                    *np.stack([np.zeros(3), end], axis=1),
                    color=color,
                    linestyle=dash,
                    linewidth=1.8,
                )
                if mark == "" or column != k:
                    x, y, z = 1.12 * end
                    ax.text(x, y, z, "xyz"[column] + mark, color=color, fontsize=10)
        _clear(ax, f"{word}: 30 degrees about {axis}")
    ax = figure.add_subplot(2, 2, 4, projection="3d")
    u, s = np.array([0.3, -0.2, 1.0]), np.array([0.8, 0.1, 0.5])
    u = u / np.linalg.norm(u)
    turn = lambda phi: np.asarray(
        stm.rotation.rotation_matrix(stm.rotation.from_rotation_vector(jnp.asarray(phi * u)))
    )
    arc = np.array([turn(phi) @ s for phi in np.linspace(0, np.pi / 2, 40)])
    for end, label, color in (
        (u, "u", "black"),
        (s, "s'", STYLES[0][0]),
        (arc[-1], "s", STYLES[1][0]),
    ):
        ax.plot(*np.stack([np.zeros(3), end], axis=1), color=color, linewidth=1.8)
        x, y, z = 1.08 * end
        ax.text(x, y, z, label, color=color, fontsize=11)
    ax.plot(*arc.T, color="0.4", linestyle=":")
    ax.plot(*np.stack([(u @ s) * u, arc[-1]], axis=1), color="0.6", linewidth=0.9)
    ax.plot(*np.stack([(u @ s) * u, s], axis=1), color="0.6", linewidth=0.9)
    _clear(ax, "rotation formula: 90 degrees about u")
    save({"rotations": figure})


def _clear(ax, title: str) -> None:
    """Equal axes without numbers."""
    ax.set(
        xlim=(-0.6, 1),
        ylim=(-0.6, 1),
        zlim=(-0.6, 1),
        xticklabels=[],
        yticklabels=[],
        zticklabels=[],
    )
    ax.set_box_aspect((1, 1, 1))
    ax.view_init(24, 32)
    ax.set_title(title, fontsize=10)


def thrusts() -> None:
    """Thrusts of cases 3 and 7, 4 and 8, as chosen here (Part III, Fig. 3.1.1 and 3.1.2)."""
    t = np.linspace(0.0, 2.0, 401)
    figure, axes = grid(1, 2, 2.8, sharey=True)
    for ax, case in zip(axes[0], (3, 4), strict=True):
        values = np.asarray(stm.uav.thrusts(case, t))
        labels = ("$F_1$ to $F_4$",) if case == 3 else tuple(f"$F_{k}$" for k in range(1, 5))
        for k, label in enumerate(labels):
            color, dash = STYLES[k]
            ax.plot(t, values[k], color=color, linestyle=dash, label=label)
        ax.set_title(f"cases {case} and {case + 4}", fontsize=10)
        ax.set_xlabel("time [s]", fontsize=9)
        ax.legend(fontsize=8)
    axes[0, 0].set_ylabel("thrust [N]", fontsize=9)
    save({"thrusts": figure})


def centres() -> None:
    """Estimated centre of mass of the eight cases, by both tunings (Part III, Fig. 3.1.3 to 3.1.18)."""
    tunings = {
        moves: [stm.uav.report_tuning(), stm.uav.consistent_tuning(5 if moves else 1)]
        for moves in (False, True)
    }
    looks = {"report": STYLES[1], "consistent": STYLES[0]}
    for first in (1, 5):
        figure, axes = grid(4, 2, 8.4, sharex=True)
        for row, case in enumerate(range(first, first + 4)):
            study = stm.uav.study_case(case, tunings[case > 4], seeds=2)
            t = np.asarray(study.record.t)
            truth = np.asarray(study.record.offset)[..., 0]
            for column, axis in enumerate("xy"):
                ax = axes[row, column]
                ax.plot(t, truth[:, column], color="0.6", linewidth=3.0, label="truth")
                for name, estimates in study.estimates.items():
                    color, dash = looks[name]
                    mean = np.asarray(estimates.mean)[:, 3 + column, 0]
                    ax.plot(t[1:], mean, color=color, linestyle=dash, linewidth=1.2, label=name)
                ax.set_ylabel(f"case {case}, {axis} [m]", fontsize=9)
            print("case", case)
        for ax in axes[-1]:
            ax.set_xlabel("time [s]", fontsize=9)
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, ncols=3, fontsize=9, loc="outside lower center")
        kind = "fixed" if first == 1 else "moving"
        figure.suptitle(
            f"Part III, cases {first} to {first + 3}: {kind} centre of mass", fontsize=10
        )
        save({f"centre_of_mass_{first}": figure})


# Hatching and names of the limits of the workspace.
_LIMITS = {
    Reason.TILT: ("tilt limit", "", "0.93"),
    Reason.SINGULAR: ("direct singularity", "////", "white"),
    Reason.STROKE_2: ("stroke of slider 2", "||||", "white"),
    Reason.STROKE_3: ("stroke of slider 3", "----", "white"),
}


def workspace() -> None:
    """Workspace of the tracker over its angles, and over directions of the normal."""
    geometry, limits = tracker_geometry(stm.PART_II), tracker_limits(stm.PART_II)
    side = np.radians(np.linspace(-70, 70, 281))
    by_angles = np.stack(np.meshgrid(side, side, indexing="ij"))
    turn, tilt = np.radians(np.linspace(0, 360, 361)), np.radians(np.linspace(0, 70, 141))
    level, up = np.sin(tilt), np.cos(tilt) * np.ones((len(turn), 1))
    normal = np.stack([np.outer(np.cos(turn), level), np.outer(np.sin(turn), level), up])
    by_direction = np.asarray(panel_angles(normal))
    x = np.degrees(tilt[None] * np.cos(turn[:, None]))
    y = np.degrees(tilt[None] * np.sin(turn[:, None]))
    levels = [1, 1.5, 2, 3, 5, 10, 50]
    figure, axes = grid(1, 2, 3.4)
    maps = ((by_angles, *np.degrees(by_angles)), (by_direction, x, y))
    shades = ScalarMappable(BoundaryNorm(levels, 256), "viridis_r")
    for ax, (angles, first, second) in zip(axes[0], maps, strict=True):
        postures = survey(geometry, angles, limits)
        reason, condition = np.asarray(postures.reason), np.array(postures.condition)
        condition[reason != Reason.VALID] = np.nan
        ax.contourf(first, second, condition, levels=levels, cmap=shades.cmap, norm=shades.norm)
        for code, (_, hatch, color) in _LIMITS.items():
            ax.contourf(first, second, (reason == code).astype(float), levels=[0.5, 1.5],
                        colors=[color], hatches=[hatch or None])  # fmt: skip
        ax.contour(
            first, second, (reason == Reason.VALID).astype(float), levels=[0.5], colors="black"
        )
        ax.set(aspect="equal", xlim=(-70, 70), ylim=(-70, 70))
        ax.grid(False)
    axes[0, 0].set(xlabel=r"$\varphi$ [degrees]", ylabel=r"$\theta$ [degrees]")
    axes[0, 1].set(xlabel="tilt towards x [degrees]", ylabel="tilt towards y [degrees]")
    bar = figure.colorbar(shades, ax=axes[0, :], shrink=0.8)
    bar.set_label("condition number, strokes by angles", fontsize=9)
    keys = [Patch(facecolor=color, edgecolor="0.3", hatch=hatch, label=words)
            for words, hatch, color in _LIMITS.values()]  # fmt: skip
    figure.legend(handles=keys, ncols=4, fontsize=8, loc="outside lower center")
    figure.suptitle("Workspace of the tracker and its limits", fontsize=10)
    save_figures({"workspace": figure}, FOLDER / "figures", "png", dpi=110)


def loads() -> None:
    """Reaction loads of case 2 of Part II over one second."""
    run = stm.simulate(stm.make_scene("uav_tracker", 2), t1=1.0)
    drawn = {"loads": stm.figures.loads_figure(run.scene, stm.dynamics.resolved_loads(run))}
    save_figures(drawn, FOLDER / "figures", "png", dpi=110)


PARTS = {
    part.__name__: part
    for part in (cases, ball_joint, hexacopter, rotations, thrusts, centres, workspace, loads)
}

if __name__ == "__main__":
    for name in sys.argv[1:] or PARTS:
        PARTS[name]()
