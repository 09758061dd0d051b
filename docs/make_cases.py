"""Make docs/cases.md and its figures from fresh runs of the report's six cases."""

from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import stmuav_jax as stm
from stmuav_jax.figures import FIGURES, save_figures

FOLDER = Path(__file__).parent

HEAD = """# The report's six cases

Two seconds of each case at the default settings (Dopri8, rtol = atol = 1e-8, projection after each
step). Position error: estimated distance from the exact motion, the largest of all bodies and
times. Violations of the constraints (lengths, angles) are the largest over all accepted steps; the
energy balance counts the work of rotors and actuators and is relative to the largest energy. Made
by `python docs/make_cases.py`.

| scene | case | position error | grows e-fold every | violation, lengths | angles | energy balance | steps |
|---|---|---|---|---|---|---|---|
"""

TEXT = """
The unactuated tracker collapses within 0.1 to 0.2 s: it has no friction, no stops and nothing that
holds its sliders. What follows is chaotic motion far outside the mechanism's physical range, and in
Part II a UAV that tips over and falls, since equal rotor speeds are not a trim. Part I is without
gravity, as printed. Joint positions are reconstructed ([geometry](geometry.md)), so curves can be
compared with the report's in kind, not in number.
"""


def main() -> None:
    rows, sections = "", ""
    for name in ("tracker", "uav_tracker"):
        for case in (1, 2, 3):
            run = stm.simulate(stm.make_scene(name, case))
            c = run.certificate
            growth = "-" if c.error_e_folding_time is None else f"{c.error_e_folding_time:.2g} s"
            rows += (
                f"| `{name}` | {case} | {c.position_error:.1e} m | {growth} "
                f"| {c.position_violation:.1e} m | {c.angle_violation:.1e} rad "
                f"| {c.relative_energy_error:.1e} | {c.accepted_steps} |\n"
            )
            place = Path("figures") / run.scene.name
            figures = {name: FIGURES[name] for name in ("pose", "joints")}
            save_figures(figures, FOLDER / place, "png", run, dpi=110)
            sections += f"\n## `{name}` case {case}\n\n{run.scene.title}.\n\n"
            sections += f"![position, tilt and angular velocity]({place}/pose.png)\n\n"
            sections += f"![strokes and panel angles]({place}/joints.png)\n"
            print(run.scene.name, c.result)
    (FOLDER / "cases.md").write_text(HEAD + rows + TEXT + sections)


if __name__ == "__main__":
    main()
