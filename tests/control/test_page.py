"""The Python of docs/control.md runs as it stands."""

import re
from pathlib import Path

import numpy as np
import pytest

PAGE = Path(__file__).parents[2] / "docs" / "control.md"


@pytest.mark.slow
def test_the_page_on_closed_loops_runs():
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) == 4
    assert len(blocks[0].splitlines()) < 40
    names: dict = {}
    exec("\n".join(blocks), names)
    assert np.max(np.abs(names["run"].states.r[-1, :, 0])) < 2e-3
    end = names["flight"].states.r[-1, 0]
    np.testing.assert_allclose(end, [np.cos(4.0) - 1, np.sin(4.0), 0.8], atol=5e-3)
    assert names["sensed"].reset().estimate.state.r.shape == (1, 3)
    assert names["climbs"][1] > names["climbs"][0]
