"""The pages that benchmarks write: failures with reasons, and honest words about other programs."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import report
from sections import failure_page, figures, state
from sections.tables import reference
from sections.throughput_page import of_peer
from shared.record import RESULTS

FOLDER = Path(__file__).parents[2] / "benchmarks"

NAN = float("nan")


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """The suite's page from the committed results."""
    return report.build(RESULTS, tmp_path_factory.mktemp("docs") / "benchmarks.md").read_text()


def tables(text):
    """Cells of all table rows of a page, without heads' rules."""
    lines = [line for line in text.splitlines() if line.startswith("|") and "---" not in line]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_no_page_says_what_another_program_cannot_do(page):
    assert "cannot model" not in page
    # what an adapter lacks is said to be the adapter's
    assert page.count("what the adapter lacks") == page.count("not about the programs")
    throughput = (FOLDER.parent / "docs" / "throughput.md").read_text()
    for text in (page, throughput):
        assert "nan" not in [cell for row in tables(text) for cell in row]


def test_rows_without_an_error_say_why():
    """In the stored results: a run with no error or no rate has its reason in words."""
    for path in sorted(RESULTS.glob("suite_*.json")):
        content = json.loads(path.read_text())
        for curve in content.get("curves", []):
            for row in curve["rows"]:
                assert row["error"] is not None or row["failure"], (path.name, row)
    for row in json.loads((RESULTS / "montecarlo.json").read_text())["peers"]:
        assert of_peer(row)[-1] or of_peer(row)[2] != "-"


@pytest.mark.parametrize(
    ("row", "cells"),
    [
        (
            {"tolerance": 1e-4, "per_second": 16036.7, "median_error": NAN, "largest_error": NAN},
            ("-", "-", "-", "Some flights (how many was not recorded) ended with a state that is "
             "not finite."),
        ),
        (
            {"step": 1e-3, "per_second": 34.8, "median_error": NAN, "largest_error": NAN,
             "not_finite": 3, "failure": "3 of 64 flights ended so."},
            ("-", "-", "-", "3 of 64 flights ended so."),
        ),
        (
            {"tolerance": 1e-5, "per_second": 129.2, "median_error": 9e-4, "largest_error": 0.21},
            ("129.2", "9.0e-04", "2.1e-01", ""),
        ),
    ],
)  # fmt: skip
def test_flights_that_were_lost_have_no_throughput(row, cells):
    row = {"method": "a program", "failure": "", **row}
    assert of_peer(row)[2:] == cells


def test_stored_page_is_that_of_the_stored_results(page):
    """Beyond its head, whose distances to the present commit grow with every commit."""
    stored = report.PAGE.read_text()
    of_stored, of_results = (text.split("## Compared with")[1] for text in (stored, page))
    assert of_stored == of_results


def test_state_of_the_results_names_every_result(page):
    section = page.split("## State of the results")[1].split("\n## ")[0]
    names = {row[0].split(",")[0] for row in tables(section)[1:]}
    assert names == {path.stem for path in RESULTS.glob("*.json")}


def test_state_of_a_result_that_left_the_history(monkeypatch):
    about = {"commit": "f" * 40, "date": "2026-11-21T18:26:22+00:00"}
    monkeypatch.setattr(state, "git", lambda *call: "12" if "--count" in call else "x")
    monkeypatch.setattr(state, "traced", lambda _: None)
    assert state.age(about) == ("no", "12, by date")
    monkeypatch.setattr(state, "traced", lambda _: "a" * 40)
    monkeypatch.setattr(state, "moved", lambda *_: 3)
    assert state.age(about) == ("as aaaaaaaaaa, the same files", "3")
    monkeypatch.setattr(state, "git", lambda *_: None)
    assert state.age(about) == ("no history here", "-")


def test_figures_name_what_they_do_not_show():
    row = {"method": "A", "error": 1e-3, "seconds": {"median": 1.0}, "failure": ""}
    failed = {**row, "method": "B", "error": None, "failure": "The step became too small."}
    lacking = {"method": "C", "reason": "No ball joints."}
    curve = {"rows": [row, failed], "unsupported": [lacking]}
    assert figures.not_drawn(curve) == [
        ("C", "not in our adapter: No ball joints."),
        ("B", "The step became too small."),
    ]


def test_reference_in_closed_form_is_called_so():
    check = {"horizon": 1.0, "second_code": None, "other_formulation": None}
    assert "The reference is the closed form" in reference(check, True)[0]
    assert "tightest tolerance" in reference(check, False)[0]


@pytest.fixture(scope="module")
def drawn():
    """Figures of docs/failure.md from the committed record."""
    return failure_page.figures(json.loads((RESULTS / "failure.json").read_text()))


def curve(ax, label):
    """Points (k, 2) of the curves of a panel with this label."""
    lines = [line for line in ax.lines if line.get_label() == label]
    return np.concatenate([np.array(line.get_data()).T for line in lines])


def test_figures_of_the_failure_page_have_units(drawn):
    text = (FOLDER.parent / "docs" / "failure.md").read_text()
    assert set(drawn) == set(re.findall(r"\(figures/failure/(\w+)\.png\)", text))
    for name, figure in drawn.items():
        whole = figure.get_supylabel()
        for ax in figure.axes:
            below = ax.get_subplotspec().is_last_row()
            left = ax.get_subplotspec().is_first_col() and not whole
            assert "[" in ax.get_xlabel() or not below, name
            # names of runs have no unit
            assert "[" in ax.get_ylabel() or not left or name == "collapse", name
        assert not whole or "[" in whole


def test_figures_of_the_failure_page_show_what_its_text_says(drawn):
    (ax,) = drawn["violation"].axes
    # half of the last digit of the page's table, and of the three that a curve's points have
    for label, end in (("corrected, default tolerances", 9.8e-2), ("corrected", 2.5e-5)):
        t, last = curve(ax, label)[-1]
        assert t == 2.0
        assert abs(last - end) <= 0.055 * 10.0 ** np.floor(np.log10(end))
    (ax,) = drawn["collapse"].axes
    times, places = curve(ax, failure_page.TIGHT).T
    # the lower three rows are those of all four misprints
    within = times[(places > 2.5) & (times >= 0.45) & (times <= 0.5)]
    assert (len(times), len(within)) == (60, 4)
    rates, _, steps, _ = drawn["stiffness"].axes
    for ax, largest in ((rates, (56, 71, 85)), (steps, (0.72, 0.84, 0.72))):
        for case, value in enumerate(largest, 1):
            t, y = curve(ax, f"case {case}").T
            assert np.max(y[t <= 0.5]) == pytest.approx(value, rel=0.01)
    for case, close in ((1, 3), (2, 15), (3, 28)):
        t, angle = curve(drawn["alignment"].axes[0], f"case {case}").T
        # a rod that still comes closer at the end has not passed
        passes = (angle < 5) & (t < 0.9995)
        assert (np.sum(passes), len(t)) == (close, 48)
    _, angle = curve(drawn["alignment"].axes[1], "case 2").T
    assert np.min(angle) > 78
