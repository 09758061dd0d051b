"""Shapes of bodies have the dimensions, masses and inertia tensors that they stand for."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stmuav_jax.figures.shapes import body_shapes, inertia_solid
from stmuav_jax.io import to_dataset


def tensor(shape, mass):
    """Inertia tensor of a solid of uniform density, by the textbook's formulas."""
    if shape.kind == "sphere":
        moments = np.full(3, 0.4 * mass * shape.size[0] ** 2)
    elif shape.kind == "cylinder":
        r, h = shape.size
        across = mass * (3 * r**2 + h**2) / 12
        moments = np.array([across, across, 0.5 * mass * r**2])
    else:
        squares = np.square(shape.size)
        moments = mass * (np.sum(squares) - squares) / 12
    w, x, y, z = shape.orientation
    R = Rotation.from_quat([x, y, z, w]).as_matrix()
    return R @ np.diag(moments) @ R.T


@pytest.mark.parametrize(
    ("kind", "moments"),
    [("sphere", (2.0, 2.0, 2.0)), ("cylinder", (3.0, 1.0, 3.0)), ("box", (1.0, 1.6, 2.1))],
)
def test_solid_has_the_inertia_of_its_body(kind, moments):
    turn = Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix()
    inertia = turn @ np.diag(moments) @ turn.T
    solid = inertia_solid(4.0, inertia)
    assert solid.kind == kind
    assert tensor(solid, 4.0) == pytest.approx(inertia, rel=1e-12, abs=1e-12)


def test_machine_is_drawn_from_its_dimensions(short_run):
    run = to_dataset(short_run)
    value = lambda name: short_run.scene.parameters[name]["value"]
    (rod,) = body_shapes(run, "rod_6")
    assert rod.kind == "cylinder"
    assert rod.size[1] == pytest.approx(value("geometry.rods")[0])
    (post,) = body_shapes(run, "post_4")
    assert post.size[1] == pytest.approx(value("geometry.post"))
    (panel, *struts) = body_shapes(run, "panel_7")
    assert (panel.kind, struts) == ("panel", [])
    assert tensor(panel, 0.89085).diagonal() == pytest.approx(np.diag(value("inertia.panel_7")))
    (slider,) = body_shapes(run, "slider_2")
    assert slider.kind in ("box", "cylinder")
    hub, *others = body_shapes(run, "hexacopter_1")
    assert len(others) == 12
    arms = [shape for shape in others if shape.size[1] > 4 * shape.size[0]]
    reach = [np.linalg.norm(arm) for arm in np.array(value("rotor.arms"))[:, :2]]
    assert [shape.size[1] for shape in arms] == pytest.approx(reach, rel=0.02)
    assert hub.kind == "cylinder"


def test_a_far_joint_is_tied_to_the_body_by_a_strut(short_run):
    run = to_dataset(short_run).copy(deep=True)
    run["joint_point_j"][0] = [0.4, 0.0, 0.0]
    solid, strut = body_shapes(run, "slider_2")
    assert np.linalg.norm(solid.position) == 0
    assert strut.size[1] == pytest.approx(0.4)
