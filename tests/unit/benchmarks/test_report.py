"""Tests of the statistics and the report of the benchmarks, and that the document matches the results."""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import report
from benchmarks.report import Pair, Table, percentile, rendered
from benchmarks.suite import GATEWAY, SITES, Suite


@pytest.mark.parametrize("suite", [GATEWAY, SITES], ids=lambda suite: suite.package)
def test_the_documents_have_the_figures_of_the_results(suite: Suite) -> None:
    sections = suite.sections(report.load(suite.results))
    for document in suite.documents:
        assert rendered(document.read_text(), sections) == document.read_text()


@pytest.mark.parametrize("suite", [GATEWAY, SITES], ids=lambda suite: suite.package)
def test_the_documents_have_markers_for_every_part(suite: Suite) -> None:
    documents = "".join(document.read_text() for document in suite.documents)
    for name in ("goals", "machine", *suite.parts):
        assert rendered(documents, {name: [Table("A title", ["a"], [["12345"]])]}) != documents, name


def test_only_the_sections_between_markers_are_replaced() -> None:
    document = "before\n<!-- loss -->\nold\n<!-- end of loss -->\nafter\n"
    table = Table("Lost", ["who", "how many"], [["a", "0"]], "In a minute.")
    expected = "**Lost**\n\n| who | how many |\n|---|---:|\n| a | 0 |\n\nIn a minute."
    new = rendered(document, {"loss": [table], "scale": [table]})
    assert new == f"before\n<!-- loss -->\n\n{expected}\n\n<!-- end of loss -->\nafter\n"
    assert rendered(new, {"loss": [table]}) == new


def test_measuring_a_part_again_keeps_the_results_of_the_others(tmp_path: Path) -> None:
    file = tmp_path / "results.json"
    for part, value in (("loss", 1), ("scale", 2), ("loss", 3)):
        report.merge(file, part, {"value": value})
    assert {part: result["value"] for part, result in report.load(file).items()} == {"loss": 3, "scale": 2}
    assert json.loads(file.read_text())["loss"]["machine"]["cores"]


def test_the_ratio_of_a_pair_compares_neighbouring_runs() -> None:
    pair = Pair("a", "b")
    for a, b in ((1, 2), (3, 4), (50, 10)):  # the machine was slow during the third pair
        pair.add("a", a)
        pair.add("b", b)
    assert pair.ratios == [0.5, 0.75, 5.0]
    assert pair.ratio == pytest.approx(0.75)
    assert Pair.of(pair.as_dict()).ratios == pair.ratios


@given(st.lists(st.floats(0, 1e6), min_size=1), st.floats(0.1, 100))
def test_the_percentile_is_the_smallest_value_that_enough_values_do_not_exceed(
    values: list[float], per_cent: float
) -> None:
    found = percentile(values, per_cent)
    assert found in values
    assert sum(value <= found for value in values) >= len(values) * per_cent / 100 - 1e-9
    assert sum(value < found for value in values) < len(values) * per_cent / 100
