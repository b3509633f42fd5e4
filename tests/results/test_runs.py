"""Every committed run folder can be read, and its tables follow from its files."""

import json
from pathlib import Path

import pytest
from experiments import ROOT

from excite.report.html import report_html
from excite.study.table import finished_table, study_table

RUNS = sorted(path.parent for path in (ROOT / "results").glob("*/run.json"))
runs = pytest.mark.parametrize("folder", RUNS, ids=lambda folder: folder.name)


@runs
def test_the_table_follows_from_the_rows_of_methods_and_seeds(folder: Path):
    committed, computed = finished_table(folder), study_table(folder)
    for part in ("rows", "differences"):  # as JSON: a number that does not exist equals itself
        assert committed.data().get(part) == computed.data().get(part)
    assert json.loads((folder / "table.json").read_text()) == committed.data()


@runs
def test_tables_of_every_format_are_those_of_the_numbers(folder: Path):
    table = finished_table(folder)
    assert (folder / "table.md").read_text() == table.markdown()
    assert (folder / "table.csv").read_text() == table.csv()
    assert (folder / "table.tex").read_text() == table.latex()


@runs
def test_a_report_can_be_made_of_it(folder: Path):
    page = report_html([folder])
    assert finished_table(folder).rows[0].method in page
