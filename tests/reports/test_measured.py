"""The committed tables are those of the committed runs: nobody typed a number."""

import pytest

from reports import store
from reports.charts import sweeps, trade_off
from reports.gathered import TABLES
from reports.request import Request
from reports.writers import csv_text, latex, markdown


@pytest.fixture(scope="module")
def measured(root):
    return root / "reports" / "measured"


@pytest.fixture(scope="module")
def found(measured):
    read, broken = store.read(measured / store.FILE_NAME)
    assert broken == [] and len(read) >= 500
    return [run.result for run in read]


@pytest.mark.parametrize("name", TABLES)
def test_the_tables_come_out_again(measured, found, name):
    table = TABLES[name](found, Request())
    if not table.blocks:
        assert not (measured / f"{name}.md").exists()
        return
    for extension, text in (("md", markdown.text), ("tex", latex.text), ("csv", csv_text.text)):
        assert (measured / f"{name}.{extension}").read_text() == text(table)


def test_the_points_of_all_charts_come_out_again(measured, found):
    made = {f"{sweep.file_name}.csv": sweeps.csv_text(sweep) for sweep in sweeps.sweeps(found, Request())}
    made |= {f"{chart.name}.csv": trade_off.csv_text(chart) for chart in trade_off.trade_offs(found, Request())}
    committed = {p.name: p.read_text() for p in measured.glob("*.csv") if p.stem not in TABLES}
    assert committed == made


def test_it_is_small(measured):
    files = [path for path in measured.rglob("*") if path.is_file()]
    assert len(files) <= 70 and sum(path.stat().st_size for path in files) < 20e6
