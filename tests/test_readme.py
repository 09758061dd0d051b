"""The Python of the README, docs/rotors.md and docs/extending.md runs; links lead somewhere."""

import re
from pathlib import Path
from typing import Any

import pytest

import stmuav_jax as stm

ROOT = Path(__file__).parents[1]
README, DOCS = ROOT / "README.md", ROOT / "docs"
pages = pytest.mark.parametrize(
    ("page", "count"),
    [(README, 3), (DOCS / "rotors.md", 2), (DOCS / "extending.md", 9)],
    ids=lambda x: str(x)[-9:],
)


@pytest.fixture
def tables():
    """Take away again what a page adds to the tables."""
    every: list[dict] = [stm.mechanics.CATALOGUE, stm.SCENES]
    own = [(table, dict(table)) for table in every]
    yield
    for table, before in own:
        table.clear()
        table.update(before)


@pytest.mark.slow
@pages
def test_python_blocks_run(page, count, tables, tmp_path, monkeypatch):
    blocks = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) == count
    names: dict[str, object] = {}
    monkeypatch.chdir(tmp_path)
    exec("\n".join(blocks), names)
    run: Any = names["run"]
    assert run.certificate.result == "successful"
    if page.stem == "extending":
        heights: Any = names["heights"]
        assert heights.tolist() == run.states.r[:, 0, 2:].tolist()


@pages
def test_links_lead_somewhere(page, count):
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#]+)\)", text):
        assert target.startswith("https:") or (page.parent / target).exists(), target


def test_the_table_of_mechanisms_names_tests():
    text = (ROOT / "docs" / "tuning.md").read_text(encoding="utf-8")
    places = dict(re.findall(r"^\[(test_\w+)\]: (\S+)$", text, re.MULTILINE))
    rows = [line for line in text.splitlines() if line.startswith("|") and "[test_" in line]
    assert len(rows) == 6
    for row in rows:
        names = re.findall(r"\[(test_\w+)\]", row)
        assert len(names) == 5
        for name in names:
            assert f"def {name}(" in (ROOT / "docs" / places[name]).read_text(encoding="utf-8")
