"""The viewer's page: its numbers are the run's, it asks for nothing, and errors name what is missing."""

import base64
import html
import json
import re

import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.cli.view import View, run_view, towards_sun
from stmuav_jax.figures.page import MOST_TIMES, content_of, joint_displacement, view
from stmuav_jax.io import FileError, save, to_dataset


@pytest.fixture(scope="module")
def data(short_run):
    return to_dataset(short_run)


def embedded(page):
    """Content of a page, as a browser reads it."""
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    return json.loads(found[1])["runs"]


def numbers(text, kind="<f4"):
    return np.frombuffer(base64.b64decode(text), kind)


def test_poses_loads_and_thrusts_are_those_of_the_run(short_run, data):
    (run,) = embedded(view(data).html)
    assert np.array_equal(numbers(run["times"], "<f8"), short_run.ts)
    states = short_run.states
    for key, values in (("positions", states.r), ("orientations", states.p)):
        assert np.array_equal(numbers(run[key]), np.asarray(values, "f4").reshape(-1))
    force = np.asarray(short_run.snapshot.reactions.force)
    assert np.array_equal(numbers(run["reactions"]), force.astype("f4").reshape(-1))
    # at hover the six rotors carry all seven bodies
    weight = 9.81 * float(np.sum(short_run.scene.system.bodies.mass))
    assert np.sum(numbers(run["rotors"]["thrust"])[:6]) == pytest.approx(weight, rel=1e-6)
    assert [body["name"] for body in run["bodies"]] == list(short_run.scene.system.names)


def test_curves_agree_with_the_run(short_run, data):
    (run,) = embedded(view(data, sun=(0, 0, 2.0)).html)
    curves = {
        each["title"]: {c["label"]: numbers(c["values"]) for c in each["curves"]}
        for each in run["curves"]
    }
    slide = curves["displacement in joints [m]"]["T12"]
    moved = short_run.joint("T12").displacement
    assert slide == pytest.approx(moved, abs=1e-7)
    assert joint_displacement(data, 0) == pytest.approx(moved, abs=1e-12)
    # towards a sun in the zenith the panel's normal is off by its tilt
    tilt = curves["tilt of z from the vertical [degrees]"]["panel 7"]
    assert curves["angle from the panel's normal to the sun [degrees]"]["panel 7"] == pytest.approx(
        tilt
    )
    z = stm.rotation.rotation_matrix(short_run.body("panel_7").p[0])[2, 2]
    assert tilt[0] == pytest.approx(np.degrees(np.arccos(z)), rel=1e-5)


def test_page_asks_for_nothing_from_outside(data):
    page = view(data, data).html
    assert "default-src 'none'" in page
    assert not re.search(r"""(?:src|href)\s*=\s*["']?(?!")|@import|url\(|<link""", page)
    # the name of a vocabulary, which no browser fetches
    assert set(re.findall(r"https?://[\w./-]+", page)) == {"http://www.w3.org/1999/xhtml"}
    assert len(page) < 1_500_000
    assert len(embedded(page)) == 2


def test_texts_of_the_run_stay_texts(data, tmp_path):
    named = data.assign_attrs(title="</script><b>{{data}}</b>")
    page = view(named)
    assert embedded(page.html)[0]["title"] == "</script><b>{{data}}</b>"
    assert "<b>" not in page.html
    # in a notebook the page is the text of a frame's attribute
    frame = re.search(r'srcdoc="([^"]*)"', page._repr_html_())
    assert frame is not None
    assert html.unescape(frame[1]) == page.html
    assert page.save(tmp_path / "run.html").read_text() == page.html


def test_long_runs_are_thinned_and_say_so(data):
    count = 3 * MOST_TIMES
    long = data.isel(time=np.zeros(count, int)).assign_coords(time=np.linspace(0.0, 6.0, count))
    found = content_of(long)
    times = numbers(found["times"], "<f8")
    assert len(times) == MOST_TIMES
    assert (times[0], times[-1]) == (0.0, 6.0)
    assert found["note"] == f"{MOST_TIMES} of {count} saved times are shown."


def test_errors_say_what_is_missing(data, short_run):
    old = data.drop_vars(["joint_point_i", "inertia"])
    with pytest.raises(FileError, match=r"saved without inertia, joint_point_i.*save it again"):
        view(old)
    with pytest.raises(FileError, match="no saved time at which all poses are finite"):
        view(data.assign(position=np.nan * data["position"]))
    lost = data["position"].where(data["time"] < short_run.ts[-1])
    assert "1 of 6 saved times are not finite" in content_of(data.assign(position=lost))["note"]
    with pytest.raises(stm.SettingError, match=r"no body 'panel'.*panel_7"):
        view(data, shapes={"panel": ()})
    with pytest.raises(stm.SettingError, match="sun has zero length"):
        view(data, sun=(0, 0, 0))
    with pytest.raises(stm.SettingError, match="one run or two side by side, not 0"):
        view()


def test_command_writes_the_page(short_run, tmp_path, capsys):
    folder = save(short_run, tmp_path / "run.nc").parent
    target = tmp_path / "out" / "page.html"
    assert run_view(View(folder, html=target, sun=(90.0, 0.0))) == 0
    said = capsys.readouterr().out
    assert "page.html" in said.replace("\n", "")
    assert "saved times" in " ".join(said.split())
    assert embedded(target.read_text())[0]["sun"] == pytest.approx([1.0, 0.0, 0.0])
    with pytest.raises(stm.SettingError, match="within -90 and 90 degrees, but it is 91"):
        towards_sun(0.0, 91.0)
