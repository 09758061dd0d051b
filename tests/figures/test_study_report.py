"""Reports of studies: what they say is what the statistics say, whatever a study holds."""

import json

import numpy as np
import pytest
import scipy.stats as st
import xarray as xr
from html_pages import Page
from study_samples import FACTORS, REASONS, study
from test_terminal import printed

from stmuav_jax.checks.errors import SettingError
from stmuav_jax.figures import study as study_plot, study_data as data_module
from stmuav_jax.figures.plot import grid
from stmuav_jax.figures.report import write_report
from stmuav_jax.figures.study_data import (
    analyse,
    save_summary,
    study_data,
    summary_lines,
    summary_table,
)
from stmuav_jax.io.netcdf import FileError
from stmuav_jax.studies.sensitivity import sobol
from stmuav_jax.studies.statistics import Intervals, mean, probability, quantiles


def tiny(count: int, **more) -> xr.Dataset:
    """A study of one input and two quantities, soon drawn."""
    found = study(count, factors={"angle": FACTORS["angle"]}, times=0, **more)
    return found[["angle", "peak", "touched", "status"]]


def strictly(text: str) -> dict:
    def refuse(word):
        raise AssertionError(f"{word} is no JSON")

    return json.loads(text, parse_constant=refuse)


def report(dataset, folder):
    """The page and the summary; each checked for form."""
    analysis = analyse(study_data(dataset))
    path = write_report(dataset, folder / "report.html", dpi=40, analysis=analysis)
    summary = save_summary(study_data(dataset), analysis, folder / "summary.json")
    assert {path, summary} == {p for p in folder.rglob("*") if p.is_file()}
    return Page(path.read_text()), strictly(summary.read_text())


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    dataset = study(1500, pending=60, correlation=[("angle", "rate", 0.3)])
    return dataset, *report(dataset, tmp_path_factory.mktemp("report"))


def test_summary_is_what_the_statistics_say(whole):
    dataset, _, summary = whole
    fine = dataset.status.values == 1
    failed = dataset.status.values > 1
    peak, fall = dataset.peak.values[fine], dataset.fall.values[fine]
    said = summary["samples"]
    assert said["total"] == 1500
    assert (said["completed"], said["not_completed"], said["not_computed"]) == (
        np.sum(fine), np.sum(failed), 60
    )  # fmt: skip
    assert tuple(said["share_not_completed"].values()) == probability(int(np.sum(failed)), 1440)
    for code, words in REASONS.items():
        assert said["reasons"][str(code)]["words"] == words
        assert said["reasons"][str(code)]["count"] == np.sum(dataset.status == code)
    found = summary["quantities"]["peak"]
    assert tuple(found["mean"].values()) == mean(peak)
    assert tuple(found["quantiles"]["0.95"].values()) == quantiles(peak, (0.95,))[0.95]
    rank = found["influence"]["rank_correlation"]["damping"]["value"]
    assert rank == pytest.approx(st.spearmanr(dataset.damping.values[fine], peak)[0])  # type: ignore
    never = summary["quantities"]["fall"]
    assert never["mean"] is None
    assert never["quantiles"]["0.95"]["value"] == "inf"
    assert never["infinite_probability"]["value"] == np.mean(np.isinf(fall))
    assert summary["quantities"]["touched"]["probability"]["value"] == np.mean(peak >= 0.5)
    assert summary["quantities"]["force[joint=panel]"]["unit"] == "N"
    assert summary["inputs"]["angle"]["values"] == 1440
    assert summary["identity"] == json.loads(dataset.attrs["identity"])


def test_saltelli_study(tmp_path):
    """Indices are of all samples, statistics of A and B; a quantity that cannot have them says why."""
    factors = {name: FACTORS[name] for name in ("payload", "rate", "angle")}
    dataset = study(5 * 128, "saltelli", factors=factors, times=0, failing=False)
    dataset = dataset.drop_vars(["force", "joint"])
    dataset = dataset[sorted(map(str, dataset.data_vars))]  # as some stores give them
    page, summary = report(dataset, tmp_path)
    found = sobol(dataset.peak.values, dataset.status.values, 3)
    said = summary["quantities"]["peak"]["influence"]
    assert list(said["sobol_total"]) == ["payload", "rate", "angle"]
    assert [x["value"] for x in said["sobol_total"].values()] == found.total.value.tolist()
    assert summary["quantities"]["peak"]["values"] == 256
    independent = dataset.peak.values.reshape(128, 5)[:, :2]
    assert summary["quantities"]["peak"]["mean"]["value"] == pytest.approx(np.mean(independent))
    assert "finite values" in summary["quantities"]["fall"]["influence"]["note"]
    assert "Sobol indices are of all samples" in " ".join(page.text)


SMALL = {
    "one, failed": (
        tiny(1).assign(status=("sample", [2], {"role": "status"})),
        "0 samples completed, 1 did not complete",
    ),
    "none fine": (
        study(40, pending=40),
        "0 samples completed, 0 did not complete, 40 not computed",
    ),
    "none": (study(0), "0 samples completed"),
    "no inputs": (tiny(30)[["status"]], "samples completed"),
}


@pytest.mark.parametrize("name", SMALL)
def test_small_studies(name, tmp_path):
    dataset, words = SMALL[name]
    page, summary = report(dataset, tmp_path)
    assert words in " ".join(page.text)
    assert summary["samples"]["total"] == dataset.sizes["sample"]


def test_words_of_a_study_are_no_html(tmp_path):
    dataset = tiny(20)
    dataset.attrs["title"] = "<script>alert(1)</script> & $x_1"
    dataset.peak.attrs["long_name"] = "<b>peak</b> of $\\alpha"
    dataset.attrs["identity"] = json.dumps(
        {"a<b": "</td>", "limit": float("inf"), "ls": [1.5] * 99}
    )
    page, summary = report(dataset, tmp_path)
    text = (tmp_path / "report.html").read_text()
    assert "<script" not in text
    assert "<b>" not in text
    assert "<script>alert(1)</script> & $x_1" in page.text
    assert "(99 in all)" in " ".join(page.text)
    assert summary["identity"]["limit"] == "inf"


def test_curves_are_read_by_blocks(monkeypatch):
    """Blocks of any size give the same curves, of the fine samples in their order."""
    data = study_data(study(300, pending=20))
    one = next(curve for curve in data.curves if curve.key == "wear[joint=panel]")
    _, expected = data.curve(one, 100)
    fine = np.flatnonzero(data.dataset.status.values == 1)[:100]
    np.testing.assert_array_equal(expected, data.dataset.wear.values[fine, :, 1])
    monkeypatch.setattr(data_module, "BLOCK", 81 * 7)
    _, found = data.curve(one, 100)
    np.testing.assert_array_equal(found, expected)


def test_axes_of_curves():
    """Time, or numbers with a unit; names and bare numbers are components."""
    dataset = study(5, times=0)
    flag = {"role": "quantity", "units": "N"}
    dataset = dataset.assign_coords(height=("height", [1.0, 2.0, 4.0], {"units": "m"}))
    dataset["drag"] = (("sample", "height"), np.ones((5, 3)), flag)
    dataset["rotors"] = (("sample", "rotor"), np.ones((5, 2)), flag)
    data = study_data(dataset)
    assert [(one.key, one.axis) for one in data.curves] == [("drag", "height")]
    assert [one.key for one in data.quantities[-2:]] == ["rotors[rotor=0]", "rotors[rotor=1]"]


def test_failure_region_takes_the_inputs_that_matter():
    """Samples fail by angle and rate, and by frequency and damping; points are thinned and said so."""
    data = study_data(study(9000, times=0))
    analysis = analyse(data)
    assert analysis.failing is not None
    order = [analysis.varying[k].key for k in np.argsort(-analysis.failing)]
    assert order[0] == "angle"
    assert set(order[-2:]) == {"offset", "payload"}
    figure = study_plot.draw_failures(data, analysis)
    assert figure is not None
    total = int(np.sum(data.dataset.status.values == 1))
    assert f"1,500 of {total:,} (others)" in figure.get_supxlabel().replace("\n", " ")
    counts = sum(int(text.get_text()) for text in figure.axes[1].texts)
    assert counts == 9000


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d.rename(sample="row"), "A study has the dimension 'sample'"),
        (lambda d: d.drop_vars("status"), "one column of the role 'status', but here are []"),
        (lambda d: d.assign_attrs(identity="{"), "'identity' is not JSON"),
        (lambda d: d.assign_attrs(reasons="[]"), "'reasons' must be a JSON object"),
    ],
)
def test_what_is_no_study(change, words):
    with pytest.raises(FileError) as caught:
        study_data(change(tiny(3)))
    assert words in str(caught.value)


def test_what_is_refused(tmp_path):
    with pytest.raises(SettingError, match="level of confidence"):
        analyse(study_data(tiny(3)), level=95.0)
    with pytest.raises(FileError, match="A report needs a run"):
        write_report(xr.Dataset(), tmp_path / "report.html")


@pytest.mark.parametrize(
    ("failure", "event", "words"),
    [
        ({"quantity": "fall"}, lambda d: np.isfinite(d.fall.values), "until the tracker touches"),
        ({"quantity": "fall", "below": 2.0}, lambda d: d.fall.values < 2.0, "below 2 s"),
        ({"quantity": "peak", "above": 1.0}, lambda d: d.peak.values > 1.0, "above 1 rad"),
    ],
)
def test_a_declared_failure_is_what_is_reported(failure, event, words):
    """Among the samples that were completed; the share that was not is another number."""
    dataset = study(400, pending=40)
    identity = json.loads(dataset.attrs["identity"]) | {"failure": failure}
    dataset.attrs["identity"] = json.dumps(identity)
    analysis = analyse(study_data(dataset))
    fine = dataset.status.values == 1
    wanted = probability(int(np.sum(event(dataset)[fine])), int(np.sum(fine)))
    assert analysis.failure is not None
    assert analysis.failure.probability == wanted
    assert words in analysis.failure.label
    said = " ".join(summary_lines(analysis))
    assert f"Probability of failure ({analysis.failure.label}): {100 * wanted.value:.3g} %" in said
    assert "did not complete" in said
    assert "40 not computed" in said


def test_without_a_declared_failure_none_is_reported():
    analysis = analyse(study_data(study(100, failing=False)))
    assert analysis.failure is None
    assert "failure" not in " ".join(summary_lines(analysis))
    assert "largest angle [rad]" in printed(summary_table(analysis), 200)


def test_shares_are_drawn_between_zero_and_one():
    """An estimate below 0 is chance: its bar ends at 0, and its interval is drawn as far as it is one."""
    analysis = analyse(study_data(study(300)))
    one = analysis.findings[0]
    names = list(one.influence.names)
    level = np.ones(len(names))
    shares = Intervals(-0.4 * level, -0.5 * level, 0.1 * level)
    finding = one._replace(influence=one.influence._replace(first=shares))
    figure, axes = grid(1, 1, 3.0)
    study_plot._share_bars(axes[0, 0], finding, names)
    assert axes[0, 0].get_xlim()[0] == 0.0
    assert [bar.get_width() for bar in axes[0, 0].patches] == [0.0] * len(names)
    del figure
