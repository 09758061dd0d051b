"""The pages that benchmarks write: those of the stored results, with reasons for what has no number."""

import json
import re
from pathlib import Path

import pytest
import report
from shared.record import RESULTS

DOCS = Path(__file__).parents[2] / "docs"
NAN = float("nan")


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """The page of the stored results, beside which they seem to be, so that its links are the same."""
    root = tmp_path_factory.mktemp("root")
    (root / "benchmarks").mkdir()
    (root / "docs").mkdir()
    (root / "benchmarks" / "results").symlink_to(RESULTS)
    return report.build(root / "benchmarks" / "results", root / "docs" / "benchmarks.md")


def table_rows(text):
    """Cells of all table rows of a page, without heads' rules."""
    lines = [line for line in text.splitlines() if line.startswith("|") and "---" not in line]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_stored_page_is_that_of_the_stored_results(page):
    assert report.PAGE.read_text() == page.read_text()


def test_tables_of_other_pages_are_those_of_the_stored_results():
    names = []
    for page in report.OTHER_PAGES:
        text = page.read_text()
        assert report.fill(text) == text, f"run `python benchmarks/report.py`: {page}"
        names += [name for _, name, _ in report.BLOCK.findall(text)]
        assert text.count("<!-- table: ") == text.count("<!-- end of table -->")
    assert sorted(names) == sorted(report.TABLES)


@pytest.mark.parametrize(("page", "title"), [("validation", "Cases"), ("studies", "One core")])
def test_sections_of_other_pages_are_filled_between_their_comments(page, title):
    text = (DOCS / f"{page}.md").read_text()
    assert report.fill(text.replace(f"### {title}\n", "")) == text


def test_links_to_the_page_have_their_places():
    text = report.PAGE.read_text()
    titles = re.findall(r"^## (.+)$", text, re.MULTILINE)
    slugs = [re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles]
    anchors = {*re.findall(r'<a id="([^"]+)">', text), *slugs}
    for path in (*DOCS.glob("*.md"), DOCS.parent / "README.md"):
        for anchor in re.findall(r"\(\S*benchmarks\.md#([\w-]+)\)", path.read_text()):
            assert anchor in anchors, (path.name, anchor)


def test_links_and_figures_of_the_page_exist():
    links = re.findall(r"\]\(([^)#]+)\)", report.PAGE.read_text())
    assert len(links) > 20
    assert all((DOCS / link).exists() for link in links)
    # every result has a link, with its runs
    assert {Path(link).name for link in links} >= {path.name for path in RESULTS.glob("*.json")}


def test_no_page_says_what_another_program_cannot_do():
    page = report.PAGE.read_text()
    assert "cannot model" not in page
    # what an adapter lacks is said to be the adapter's
    assert "not in our adapter" in page
    assert "not of the program" in page
    for text in (page, (DOCS / "validation.md").read_text()):
        assert "nan" not in [cell for row in table_rows(text) for cell in row]


def test_rows_without_an_error_say_why():
    """In the stored results: a run with no error or no rate has its reason in words."""
    for path in sorted(RESULTS.glob("suite_*.json")):
        content = json.loads(path.read_text())
        for curve in content.get("curves", []):
            for row in curve["rows"]:
                assert row["error"] is not None or row["failure"], (path.name, row)
    for row in json.loads((RESULTS / "montecarlo.json").read_text())["peers"]:
        assert (report.batch_result(row)[-1] != "-") == (report.batch_result(row)[0] == "-")


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
            ("129.2", "9.0e-04", "2.1e-01", "-"),
        ),
    ],
)  # fmt: skip
def test_flights_that_were_lost_have_no_throughput(row, cells):
    row = {"method": "a program", "failure": "", **row}
    assert report.batch_result(row) == cells
