"""Every committed run folder makes a page, with the table that the command line prints."""

import pytest
from experiments import ROOT
from test_html_report import assert_is_the_page_of_a_study


@pytest.mark.parametrize(
    "name", sorted(path.parent.name for path in ROOT.glob("results/*/run.json"))
)
def test_a_committed_run_makes_one_small_page(name, capsys):
    assert_is_the_page_of_a_study(name, capsys)
