"""Every notebook runs, and its last cell asserts its claim."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

# What the notebook shows is tested otherwise by default; its own run takes minutes.
LONG = (
    "02_what_fails_at_half_a_second",
    "04_a_day_of_pointing_at_the_sun",
    "05_centre_of_mass",
    "06_trim_and_small_motions",
    "07_inputs_by_gradients",
    "08_parameters_from_a_record",
)
NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize(
    "path",
    [pytest.param(p, id=p.stem, marks=[pytest.mark.slow] * (p.stem in LONG)) for p in NOTEBOOKS],
)
def test_notebook(path):
    notebook = nbformat.read(path, as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert "assert" in code[-1].source
    assert all(len(cell.source.splitlines()) <= 25 for cell in code)
    assert all(cell.outputs or cell is code[0] or "=" in cell.source for cell in code)
    assert path.stat().st_size < 300_000
    NotebookClient(notebook, timeout=900, kernel_name="python3").execute()
