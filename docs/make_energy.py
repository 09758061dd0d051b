"""Figures and numbers of docs/energy.md; takes less than a minute.

    python docs/make_energy.py

Writes docs/figures/energy/*.png and numbers.json.
"""

import json
from datetime import date, timedelta, timezone
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import stmuav_jax as stm
from stmuav_jax.figures import STYLES, grid, save_figures

FOLDER = Path(__file__).parent / "figures" / "energy"
UAV, ENERGY = stm.parameters.PART_II, stm.parameters.ENERGY
K_F, K_TAU = UAV.value("rotor.k_f"), UAV.value("rotor.k_tau")
AIR = {"density": ENERGY.value("air.density"), "radius": ENERGY.value("rotor.radius")}
FLOWN = {"gravity": UAV.value("gravity"), "k_f": K_F, "k_tau": K_TAU, "count": 6}
GOOD_MERIT = 0.7  # figure of merit of a good rotor of this size
LIGHT = 0.3  # mass per area of a light panel, thin cells on a film [kg/m^2]
SUN = 1000.0  # irradiance of a panel that faces the sun [W/m^2]


def rotors() -> dict:
    """Power in hover of the report's rotors, and what momentum theory makes of it."""
    mass = float(stm.flight.uav_mass())
    squared = stm.rotorcraft.hover_speed_squared(mass, FLOWN["gravity"], K_F, 6)
    omega = float(jnp.sqrt(squared[0]))
    power = float(stm.rotorcraft.hover_power(mass, **FLOWN))
    thrust = float(K_F * squared[0])
    merit = {
        f"{radius:g} m": float(
            stm.rotorcraft.figure_of_merit(
                k_f=K_F, k_tau=K_TAU, density=AIR["density"], radius=radius
            )
        )
        for radius in (0.1, 0.127, 0.15, 0.175)
    }
    return {
        "mass kg": mass,
        "speed rad/s": omega,
        "speed 1/min": omega * 30 / np.pi,
        "tip speed m/s": omega * AIR["radius"],
        "thrust of one rotor N": thrust,
        "mechanical power W": power,
        "ideal power W": 6 * float(stm.rotorcraft.induced_power(thrust, **AIR)),
        "figure of merit by radius": merit,
        "radius of figure of merit one m": AIR["radius"] * merit["0.15 m"],
        "electrical power W": float(stm.flight.hover_demand(mass)),
        "electrical power per mass W/kg": float(jax.grad(stm.flight.hover_demand)(mass)),
    }


def a_day() -> tuple[dict, Figure]:
    """Endurance of the four outfits for flights that begin every half hour, Phnom Penh in March."""
    place = stm.environment.Place.degrees(11.55, 104.92, 12.0)
    day = stm.tracker.track_day(place, date(2024, 3, 21), timezone(timedelta(hours=7)), step=600.0)
    hours = np.arange(0.0, 23.6, 0.5)
    found = {
        name: stm.flight.day_endurance(day, outfit, hours)
        for name, outfit in stm.flight.uav_outfits().items()
    }
    table = {}
    figure, axes = grid(1, 2, 3.2)
    for (name, each), (color, dash) in zip(found.items(), STYLES, strict=True):
        assert np.all(np.asarray(each.reason) == stm.rotorcraft.BatteryReason.EMPTY)
        seconds = np.asarray(each.endurance)
        axes[0, 0].plot(hours, seconds / 60, color=color, linestyle=dash, linewidth=1.6, label=name)
        gain = seconds - seconds[0]
        if np.max(gain) > 1e-6:
            axes[0, 1].plot(hours, gain, color=color, linestyle=dash, linewidth=1.6, label=name)
        table[name] = {
            "mass kg": float(np.asarray(stm.flight.uav_outfits()[name].mass)),
            "demand W": float(each.demand),
            "largest panel power W": float(np.max(each.panel_power)),
            "endurance at night s": float(seconds[0]),
            "endurance at best s": float(np.max(seconds)),
        }
    axes[0, 0].set_ylabel("endurance in hover [min]", fontsize=9)
    axes[0, 0].set_ylim(0, None)
    axes[0, 0].set_title("what mass costs", fontsize=10)
    axes[0, 1].set_ylabel("longer than at night by [s]", fontsize=9)
    axes[0, 1].set_ylim(0, None)
    axes[0, 1].set_title("what light gives", fontsize=10)
    for ax in axes.flat:
        ax.set_xlabel("beginning of the flight [h]", fontsize=9)
        ax.set_xlim(0, 24)
        ax.set_xticks(range(0, 25, 6))
        ax.legend(fontsize=8)
    cells = stm.tracker.SolarCells.of()
    up = day.is_up
    more = np.mean((day.irradiance["tracker"] - day.irradiance["airframe"])[up])
    heavier = found["tracker"].demand - found["fixed panel"].demand
    gained = more * cells.efficiency * cells.converter_efficiency
    table["tracker over fixed panel"] = {
        "more light while the sun is up W/m^2": float(more),
        "more power for the tracker's mass W": float(heavier),
        "area at which both are equal m^2": float(heavier / gained),
    }
    return table, figure


def elasticities() -> dict:
    """Relative change of endurance per relative change of a parameter, tracker at full sun."""
    names = {
        "cells.area": ENERGY, "cells.efficiency": ENERGY, "battery.capacity": ENERGY,
        "battery.resistance": ENERGY, "rotor.efficiency": ENERGY,
        "rotor.k_tau": UAV, "rotor.k_f": UAV, "mass.panel_7": UAV,
    }  # fmt: skip
    x = jnp.array([table.value(name) for name, table in names.items()])

    def time(x: jax.Array) -> jax.Array:
        given = dict(zip(names, x, strict=True))
        tables = [
            table.replaced({name: given[name] for name in names if names[name] is table})
            for table in (UAV, ENERGY)
        ]
        demand = stm.flight.hover_demand(stm.flight.uav_mass(tables[0]), *tables)
        power = demand - stm.tracker.SolarCells.of(tables[1]).power(SUN)
        return stm.rotorcraft.endurance(stm.rotorcraft.Battery.of(tables[1]), power)

    value, slope = jax.jit(jax.value_and_grad(time))(x)
    return dict(zip(names, np.asarray(x * slope / value).tolist(), strict=True))


def design(merit: float, fixed: float, areal_mass: float) -> stm.flight.PanelDesign:
    """Panel on the bare hexacopter in full sun, with rotors of some figure of merit."""
    own = float(stm.rotorcraft.figure_of_merit(k_f=K_F, k_tau=K_TAU, **AIR))
    factor = float(stm.rotorcraft.hover_power(1.0, **FLOWN)) * own / merit
    cells = ENERGY.value("cells.efficiency") * ENERGY.value("cells.converter_efficiency")
    return stm.flight.PanelDesign(
        factor / ENERGY.value("rotor.efficiency"), UAV.value("bare.mass"), fixed,
        SUN * cells, areal_mass,
    )  # fmt: skip


def does_it_pay() -> tuple[dict, Figure]:
    """Heaviest panel that pays over the cells' efficiency, and gain over area at one mass per area."""
    own = float(stm.rotorcraft.figure_of_merit(k_f=K_F, k_tau=K_TAU, **AIR))
    cells_area, efficiency = ENERGY.value("cells.area"), ENERGY.value("cells.efficiency")
    mechanism = float(stm.flight.uav_mass()) - UAV.value("bare.mass") - UAV.value("mass.panel_7")
    report = UAV.value("mass.panel_7") / cells_area
    table: dict = {"mass of the tracker without panel kg": mechanism,
                   "mass per area of the report's panel kg/m^2": report}  # fmt: skip
    figure, axes = grid(1, 2, 3.6)
    area, efficiencies = np.linspace(0.0, 6.0, 121), np.linspace(0.0, 0.4, 5)
    styles = iter(STYLES)
    for rotors_of, merit in (
        ("report's rotors", own),
        (f"figure of merit {GOOD_MERIT:g}", GOOD_MERIT),
    ):
        for kind, fixed in (("fixed panel", 0.0), ("tracker", mechanism)):
            color, dash = next(styles)
            line = {"color": color, "linestyle": dash, "linewidth": 1.5}
            words = f"{kind}, {rotors_of}"
            here = design(merit, fixed, LIGHT)
            found = stm.flight.break_even(here)
            heaviest = float(np.asarray(here.areal_power)) / float(found.needed)
            table[words] = {
                "needed W/kg": float(found.needed),
                "heaviest that pays kg/m^2": heaviest,
                "gain of the report's panel W": float(
                    stm.flight.panel_gain(design(merit, fixed, report), cells_area)
                ),
                f"pays at {LIGHT:g} kg/m^2 from m^2": float(found.smallest),
                f"pays at {LIGHT:g} kg/m^2 to m^2": float(found.largest),
            }
            axes[0, 0].plot(efficiencies, heaviest * efficiencies / efficiency, label=words, **line)
            axes[0, 1].plot(area, np.asarray(stm.flight.panel_gain(here, area)), **line)
            if 1e-6 < float(found.smallest) < area[-1]:
                axes[0, 1].plot(found.smallest, 0.0, "o", color=color, markersize=5)
    axes[0, 0].set_ylim(0, 2.6)
    axes[0, 0].set_xlim(0, 0.4)
    axes[0, 0].text(0.015, 1.66, f"the report's panel: {report:.0f} kg/m²", fontsize=8)
    axes[0, 0].set_title("a panel pays below its line", fontsize=10)
    axes[0, 0].set_xlabel("efficiency of the cells [1]", fontsize=9)
    axes[0, 0].set_ylabel("panel's mass per area [kg/m²]", fontsize=9)
    axes[0, 0].legend(fontsize=8, loc="upper left")
    axes[0, 1].axhline(0.0, color="0.4", linewidth=0.8)
    axes[0, 1].set_title(f"panels of {LIGHT:g} kg/m², cells of {100 * efficiency:g} %", fontsize=10)
    axes[0, 1].set_xlabel("area of the panel [m²]", fontsize=9)
    axes[0, 1].set_ylabel("cells less rotors [W]", fontsize=9)
    return table, figure


def main() -> None:
    day, of_day = a_day()
    panel, of_panel = does_it_pay()
    save_figures({"endurance": of_day, "panel": of_panel}, FOLDER, dpi=120)
    numbers = {"rotors": rotors(), "day": day, "elasticity of endurance": elasticities(),
               "design": panel}  # fmt: skip
    (FOLDER / "numbers.json").write_text(json.dumps(numbers, indent=1) + "\n")


if __name__ == "__main__":
    main()
