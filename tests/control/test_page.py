"""The Python of docs/control_and_missions.md runs as it stands."""

import re
from pathlib import Path

import numpy as np
import pytest

PAGE = Path(__file__).parents[2] / "docs" / "control_and_missions.md"


@pytest.mark.slow
def test_the_page_on_closed_loops_runs(tmp_path, monkeypatch):
    page, _, _ = PAGE.read_text(encoding="utf-8").partition("\n## Missions\n")
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert len(blocks) == 5
    # a user's cart-pole, and a plain hexacopter
    assert len(blocks[0].splitlines()) < 40
    flight = next(block for block in blocks if "FlightController" in block)
    assert len(flight.splitlines()) < 40
    names: dict = {}
    monkeypatch.chdir(tmp_path)
    exec("\n".join(blocks), names)
    assert np.max(np.abs(names["run"].states.r[-1, :, 0])) < 2e-3
    end = names["flight"].states.r[-1, 0]
    np.testing.assert_allclose(end, [np.cos(4.0) - 1, np.sin(4.0), 0.8], atol=5e-3)
    assert names["sensed"].reset().estimate.state.r.shape == (1, 3)
    # a load of 0.4 kg at (0.05, -0.03) m, across the thrust
    np.testing.assert_allclose(names["lifted"].signal("payload")[-1, 0], 0.4, atol=0.1)
    np.testing.assert_allclose(
        names["lifted"].signal("payload")[-1, 1:3], [0.02, -0.012], atol=0.01
    )
    assert names["climbs"][1] > names["climbs"][0]
