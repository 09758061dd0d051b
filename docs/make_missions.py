"""Make the table of flights of docs/control_and_missions.md from fresh flights of the ready missions.

    python docs/make_missions.py                 all; some fifteen minutes of processor time
    python docs/make_missions.py slew-30 gusts   only these; the other rows stay as they are

Flights are made by `fly` with the missions' own sensors, lengths and tolerances, as `stmuav fly
MISSION` does. Prints each verdict.
"""

import sys
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import stmuav_jax as stm

PAGE = Path(__file__).parent / "control_and_missions.md"
BEGIN = "<!-- table made by docs/make_missions.py -->\n\n"
END = "\n<!-- end of the table -->\n"
ORDER = (
    "hover", "case-1", "case-2", "case-3", "sun-slew", "sun-day", "waypoints", "wind-step", "gusts",
    "slew-30", "rotor-weak", "slider-jammed", "rotor-lost", "rotor-lost-known", "battery",
    "takeoff-and-land",
)  # fmt: skip
# Column of the table, and how the name of its measure begins.
COLUMNS = {
    "position": "Largest position error",
    "tilt": "Largest tilt error",
    "panel": "Largest panel error",
    "rotor-speed margin": "Smallest margin of the rotor speeds",
    "stroke margin": "Smallest margin of the strokes",
}
HEAD = (
    f"| mission | time flown | {' | '.join(COLUMNS)} | verdict |\n|{'---|' * (len(COLUMNS) + 3)}\n"
)
# Errors above this are those of a machine that falls [m].
FALLS = 3.0


def shown(measure: stm.missions.Measure) -> str:
    """Value of a measure with its unit, and whether its tolerance was not met."""
    value, unit = measure.value, measure.unit
    if measure.text == f"0 {unit}":
        words = "round-off"
    elif unit == "m":
        words = f"{100 * value:.2g} cm" if value < 1 else f"{value:.2g} m"
    elif unit == "degrees":
        words = f"{value:.2g} deg" if value < 100 else f"{value:.0f} deg"
    else:
        words = "0 %, at a limit" if abs(value) < 1e-6 else f"{value:.0f} %"
    return words if measure.is_met else f"{words}, not met"


def row(name: str, data: object) -> str:
    """Row of the table for a flight's dataset."""
    kept, _ = stm.missions.verdict(data)  # pyright: ignore[reportArgumentType]
    found = stm.missions.measures(data)  # pyright: ignore[reportArgumentType]
    ending, end = data.attrs["ending"], float(data.time.values[-1])  # pyright: ignore
    cells = []
    for begins in COLUMNS.values():
        own = [one for one in found if one.name.startswith(begins)]
        cells.append(shown(own[0]) if own else "-")
    falls = found[0].value > FALLS
    judged = "met" if kept else "it falls" if falls else ending or "not met"
    cells = [] if falls else cells
    told = " | ".join(cells) if cells else "| | | |"
    return f"| `{name}` | {end:g} s | {told} | {judged} |\n"


def rows_of(page: str) -> dict[str, str]:
    """Rows of the page's table by the mission's name."""
    table = page.split(BEGIN)[1].split(END)[0]
    lines = [line for line in table.splitlines() if line.startswith("| `")]
    return {line.split("`")[1]: f"{line}\n" for line in lines}


def with_rows(page: str, rows: dict[str, str]) -> str:
    """Page with these rows in its table."""
    before, rest = page.split(BEGIN)
    table = HEAD + "".join(rows[name] for name in ORDER if name in rows)
    return before + BEGIN + table + END + rest.split(END)[1]


def main() -> None:
    for name in sys.argv[1:] or ORDER:
        flight = stm.missions.fly(stm.missions.load_mission(name))
        data = stm.missions.to_data(flight)
        print(name, *stm.missions.verdict(data), flush=True)
        page = PAGE.read_text(encoding="utf-8")
        # after each flight, so that an interrupted call keeps what it has
        new = with_rows(page, rows_of(page) | {name: row(name, data)})
        PAGE.write_text(new, encoding="utf-8")


if __name__ == "__main__":
    main()
