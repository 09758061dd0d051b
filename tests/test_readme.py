"""The Python of the README and of docs/rotors.md runs as it stands."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README, ROTORS = ROOT / "README.md", ROOT / "docs" / "rotors.md"
pages = pytest.mark.parametrize(
    ("page", "count"), [(README, 3), (ROTORS, 2)], ids=lambda x: str(x)[-9:]
)


@pytest.mark.slow
@pages
def test_python_blocks_run(page, count):
    blocks = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) == count
    names: dict[str, object] = {}
    exec("\n".join(blocks), names)
    assert names["run"].certificate.result == "successful"  # pyright: ignore


@pages
def test_links_lead_somewhere(page, count):
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#]+)\)", text):
        assert target.startswith("https:") or (page.parent / target).exists(), target
