"""The committed tables are those of the committed results: nobody typed a number."""

import pytest

from padgs import results
from reports.charts import sweeps, trade_off
from reports.gathered import TABLES
from reports.request import Request
from reports.writers import csv_text, latex, markdown

RUNS = "results"  # of reports/measured; made by `padgs report all ... --out reports/measured --collect`


@pytest.fixture(scope="module")
def measured(root):
    folder = root / "reports" / "measured"
    if not (folder / RUNS).is_dir():
        pytest.skip(f"nothing measured yet: no {folder / RUNS}")
    return folder


@pytest.fixture(scope="module")
def found(measured):
    read, broken = results.read_all(measured / RUNS)
    assert broken == []
    return read


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
    assert sum(path.stat().st_size for path in files if RUNS in path.parts) < 20e6
    assert not list((measured / RUNS).rglob("*.png"))
