"""Every notebook runs, its last cell asserts its claim, and it shows what it gives today."""

import ast
import importlib
import math
import os
import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

# Real flights, which are not part of the package: cells with this tag show them where they lie beside the checkout.
FLIGHTS, REAL = Path(__file__).parents[2] / "shared" / "flights", "real-flights"
PICTURES = Path(__file__).parents[1] / "docs" / "make_pictures.py"
NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))

# Most of a notebook's programs run once: machine code without optimisation has the same bits and compiles faster.
UNOPTIMISED = """from stmuav_jax.math.native import llvm
llvm.settings = llvm.Settings(0)"""

# Notebooks whose stored outputs are not those of the present package, with the reason. A notebook
# that is executed again has to be taken out.
STALE: dict[str, str] = {}

# Figures of a run repeat to this (relative), and one unit of the last digit that is printed.
REPEATS = 1e-3
# Steps of a chaotic motion, and estimates of its errors, feel the rounding of the processor: on two kinds the
# same code took 165 and 168 steps, 609 and 605, and had energy errors of 5.6e-9 and 8.7e-9 J. They repeat to this:
# counts of more than 100 in cells that print steps, and a certificate's numbers of these names, to a factor of two.
COUNTS, COUNTED, ESTIMATES = 0.03, 100, 0.5
FELT = re.compile(r"\w*(?:_error(?:_end)?|steps\w*)=([^,)]*)")
# Below this, numbers are residuals at the level of round-off: they have to stay there, no more.
ROUND_OFF = 1e-9

# What differs from run to run and from machine to machine: addresses, durations of the clock,
# versions, and figures, which are not text.
MASKED = (
    r"0x[0-9a-f]+",
    r"\w*(?:seconds|_at_start|load)\w*=[^,)]*",
    r"(?:in|took|takes|compile|run) \d+(?:\.\d+)? (?:s|ms|min) (?:of|on|for) [^\n]*",
    r"\b\d+\.\d+\.\d+(?:[.+\w]*)",
    r"<Figure size [^>]*>",
)
NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?![\w]*[A-Za-z_])")


def words_and_numbers(text: str) -> tuple[str, list[str]]:
    """A text with "#" for every number, white space made one blank; and the numbers as printed."""
    for pattern in MASKED:
        text = re.sub(pattern, "masked", text)
    numbers = NUMBER.findall(text)
    return " ".join(NUMBER.sub(" # ", text).split()), numbers


def last_digit(number: str) -> float:
    """One unit of the last digit that is printed."""
    mantissa, _, power = number.lower().partition("e")
    decimals = len(mantissa.partition(".")[2])
    return 10.0 ** (int(power or 0) - decimals)


def agree(old: str, new: str, repeats: float = REPEATS, counts: float = REPEATS) -> bool:
    """Whether two printed numbers are those of the same computation, to relative tolerances."""
    if old == new:
        return True
    a, b = float(old), float(new)
    if max(abs(a), abs(b)) < ROUND_OFF:
        return True
    unit = max(last_digit(old), last_digit(new))
    many = old.isdecimal() and new.isdecimal() and min(a, b) > COUNTED
    return math.isclose(a, b, rel_tol=counts if many else repeats, abs_tol=1.001 * unit)


def texts(cell: nbformat.NotebookNode) -> str:
    """What a cell prints and returns, as text; what goes to stderr and pictures are left out."""
    parts = []
    for output in cell.outputs:
        if output.output_type == "stream" and output.name == "stdout":
            parts.append(output.text)
        elif "data" in output and "image/png" not in output.data:
            parts.append(output.data.get("text/plain", ""))
    return "\n".join(parts)


def differences(stored: nbformat.NotebookNode, now: nbformat.NotebookNode) -> list[str]:
    """Where the stored outputs are not those of today, in words."""
    found = []
    for k, (old, new) in enumerate(zip(stored.cells, now.cells, strict=True)):
        if old.cell_type != "code" or (
            REAL in old.metadata.get("tags", ()) and not FLIGHTS.is_dir()
        ):
            continue
        own = [texts(cell) for cell in (old, new)]
        felt = [FELT.findall(text) for text in own]
        (old_words, old_numbers), (new_words, new_numbers) = (
            words_and_numbers(FELT.sub("felt", text)) for text in own
        )
        if old_words != new_words or len(old_numbers) != len(new_numbers):
            found.append(f"cell {k}: stored {texts(old)[:200]!r}, today {texts(new)[:200]!r}")
            continue
        pairs = zip(old_numbers, new_numbers, strict=True)
        counts = COUNTS if "steps" in own[0] else REPEATS
        off = [(a, b) for a, b in pairs if not agree(a, b, counts=counts)]
        each = zip(*felt, strict=True)
        off += [(a, b) for a, b in each if not agree(a, b, ESTIMATES, ESTIMATES)]
        off = [f"{a} was stored, {b} comes out" for a, b in off]
        found += [f"cell {k}: {', '.join(off[:5])} ({len(off)} numbers differ)"] if off else []
    return found


def code_of(path: Path) -> str:
    """The Python of a script or of a notebook, whose magic commands are left out."""
    if path.suffix == ".py":
        return path.read_text(encoding="utf-8")
    cells = nbformat.read(path, as_version=4).cells
    lines = "\n".join(c.source for c in cells if c.cell_type == "code").splitlines()
    return "\n".join(line for line in lines if not line.startswith("%"))


@pytest.mark.parametrize("path", [*NOTEBOOKS, PICTURES], ids=lambda p: p.stem)
def test_what_is_imported_exists(path, monkeypatch):
    """Notebooks run among the slow tests only, the pictures' script in none."""
    monkeypatch.syspath_prepend(str(path.parent))
    for node in ast.walk(ast.parse(code_of(path))):
        if isinstance(node, ast.Import):
            for alias in node.names:
                importlib.import_module(alias.name)
        elif isinstance(node, ast.ImportFrom):
            module = importlib.import_module(str(node.module))
            for alias in node.names:
                if not hasattr(module, alias.name):
                    importlib.import_module(f"{node.module}.{alias.name}")


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook(path, monkeypatch):
    if "workers=" in code_of(path):
        # A worker has one thread. If it compiles a program itself, its bits are those of this process only
        # with XLA's own emitters, which the other notebooks go without.
        flags = os.environ["XLA_FLAGS"].replace("--xla_cpu_use_fusion_emitters=false", "")
        monkeypatch.setenv("XLA_FLAGS", flags)
    notebook = nbformat.read(path, as_version=4)
    stored = nbformat.read(path, as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert "assert" in code[-1].source
    assert all(len(cell.source.splitlines()) <= 25 for cell in code)
    assert all(cell.outputs or cell is code[0] or "=" in cell.source for cell in code)
    assert path.stat().st_size < 300_000
    notebook.cells.insert(0, nbformat.v4.new_code_cell(UNOPTIMISED))
    where = {"metadata": {"path": str(path.parent)}}  # as Jupyter starts it
    client = NotebookClient(notebook, timeout=900, kernel_name="python3", resources=where)
    client.execute()
    del notebook.cells[0]
    found = differences(stored, notebook)
    if path.stem in STALE:
        assert found, f"{path.stem} shows what runs today: take it out of STALE."
    else:
        assert not found, "Execute the notebook again and store it:\n" + "\n".join(found)


@pytest.mark.parametrize(
    ("old", "new", "same"),
    [
        ("457 steps", "606 steps", False),
        ("606 steps", "607 steps", True),
        ("1.8e-15 m", "1.5e-16 m", True),
        ("1.8e-15 m", "1.5e-6 m", False),
        ("tilted by 57.7 degrees", "tilted by  57.8 degrees", True),
        ("tilted by 57.7 degrees", "tilted by 57.9 degrees", False),
        ("[ 1.  -2. ]", "[1. -2.]", True),
        ("result='successful'", "result='failed'", False),
        ("2 of 3", "2 of 3 and 4", False),
        ("<Legend at 0x7f5be06a5d50>", "<Legend at 0x7aa>", True),
        ("run_seconds=0.53, steps=4)", "run_seconds=9.1, steps=4)", True),
        ("jax 0.10.2", "jax 0.11.0", True),
        ("low=-0.3674, high=1e+07", "low=-0.3674, high=3e+07", False),
        ("U35 at 4.2 h, e1 of p4", "U35 at 4.3 h, e1 of p4", True),
    ],
)
def test_what_counts_as_the_same_output(old, new, same):
    def notebook(text):
        cell = nbformat.v4.new_code_cell("x")
        cell.outputs = [nbformat.v4.new_output("stream", name="stdout", text=text)]
        return nbformat.v4.new_notebook(cells=[cell])

    assert (differences(notebook(old), notebook(new)) == []) == same
