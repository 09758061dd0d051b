"""Make the tables of docs/parameters.md from the package's parameter tables."""

from pathlib import Path

import numpy as np

import stmuav_jax as stm

PAGE = Path(__file__).parent / "parameters.md"
MARK = "<!-- made by docs/make_parameters.py from here on -->\n"


def shown(value: object) -> str:
    """A value in few words: numbers as they are, matrices by their rows."""
    array = np.asarray(value, dtype=float)
    if array.ndim < 2:
        return ", ".join(f"{x:.6g}" for x in array.ravel())
    return "; ".join(", ".join(f"{x:.6g}" for x in row) for row in array)


def table(parameters: stm.mechanics.Parameters) -> str:
    """Markdown table of all keys with value, unit and source."""
    rows = ["| key | value | unit | source |", "|---|---|---|---|"]
    for key, entry in parameters.items():
        source = entry.source.replace("|", "\\|")
        rows.append(f"| `{key}` | {shown(entry.value)} | {entry.unit} | {source} |")
    return "\n".join(rows)


def tables() -> str:
    """All tables of the page."""
    which = {
        "Part II: `uav_tracker`, `hexacopter`, `sun`, studies, missions": stm.PART_II,
        "Part I: `tracker`": stm.PART_I,
        "Energy: `stm.uav.ENERGY`": stm.uav.ENERGY,
    }
    return "\n".join(f"\n## {title}\n\n{table(found)}\n" for title, found in which.items())


def main() -> None:
    text = PAGE.read_text(encoding="utf-8").split(MARK)[0]
    PAGE.write_text(f"{text}{MARK}{tables()}", encoding="utf-8")


if __name__ == "__main__":
    main()
