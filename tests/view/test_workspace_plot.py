"""The figure of the workspace."""

import io

from stmuav_jax import PART_I, tracker_geometry, tracker_limits
from stmuav_jax.view.workspace_plot import workspace


def test_shows_what_ends_the_workspace():
    figure = workspace(tracker_geometry(PART_I), tracker_limits(PART_I), points=41)
    left, right = figure.axes[:2]
    for ax in (left, right):
        assert {"T", "S", "2", "3"} <= {text.get_text() for text in ax.texts}
        assert "degrees" in ax.get_xlabel()
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    assert len(buffer.getvalue()) > 10_000
