"""The Python of the README, docs/multirotors.md and docs/models.md runs."""

import re
from pathlib import Path
from typing import Any

import pytest

import stmuav_jax as stm

ROOT = Path(__file__).parents[1]
README, DOCS = ROOT / "README.md", ROOT / "docs"


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
@pytest.mark.parametrize(
    ("page", "count"),
    # the first and the last block of multirotors.md run in tests/test_docs.py and uav/test_battery.py
    [(README, 3), (DOCS / "multirotors.md", 2), (DOCS / "models.md", 11)],
    ids=lambda x: str(x)[-9:],
)
def test_python_blocks_run(page, count, tables, tmp_path, monkeypatch):
    blocks = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    if page.stem == "multirotors":
        blocks = blocks[1:-1]
    assert len(blocks) == count
    names: dict[str, object] = {}
    monkeypatch.chdir(tmp_path)
    (tmp_path / "docs").symlink_to(DOCS)
    exec("\n".join(blocks[:count]), names)
    run: Any = names["run"]
    assert run.certificate.result == "successful"
    if page.stem == "models":
        heights: Any = names["heights"]
        assert heights.tolist() == run.states.r[:, 0, 2:].tolist()


def test_the_table_of_mechanisms_names_tests():
    text = (ROOT / "docs" / "validation.md").read_text(encoding="utf-8")
    places = dict(re.findall(r"^\[(test_\w+)\]: (\S+)$", text, re.MULTILINE))
    rows = [line for line in text.splitlines() if line.startswith("|") and "[test_" in line]
    assert len(rows) == 5
    for row in rows:
        names = re.findall(r"\[(test_\w+)\]", row)
        assert 2 <= len(names) <= 5
        for name in names:
            assert f"def {name}(" in (ROOT / "docs" / places[name]).read_text(encoding="utf-8")


def test_the_headline_gives_the_times_of_the_table():
    """The times of the bullet are those of the README's table, in its column of 1e-6 m."""
    text = README.read_text(encoding="utf-8")
    bullet = re.search(
        r"takes (\S+ ms) on one core; Pinocchio in C\+\+ takes\s+(\S+ ms), MuJoCo (\S+ s)", text
    )
    assert bullet is not None
    rows = dict(re.findall(r"^\| ([^|]+) \|[^|]*\| ([^|]*) \|", text, re.MULTILINE))
    assert list(bullet.groups()) == [rows[k] for k in ("stmuav_jax", "Pinocchio in C++", "MuJoCo")]
