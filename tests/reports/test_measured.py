"""The committed tables are those of the committed runs: nobody typed a number."""

from pathlib import Path

import pytest
from made_up import assert_apart

from padgs.reports import REPORTS, store
from padgs.reports.charts import trade_off, trade_off_chart
from padgs.reports.charts.drawing import Chart
from padgs.reports.files import files
from padgs.reports.frame import frame
from padgs.reports.gathered import Gathered
from padgs.reports.methods import short
from padgs.reports.writers import csv_text

TABLES = [name for name, report in REPORTS.items() if report.function.startswith("padgs.reports.tables.")]


@pytest.fixture(scope="module")
def measured(root):
    return root / "reports" / "measured"


@pytest.fixture(scope="module")
def found(measured):
    read, broken = store.read(measured / store.FILE_NAME)
    assert broken == [] and len(read) >= 50
    return Gathered(frame(read))


@pytest.fixture(scope="module")
def all_trade_offs(found):
    return {chart.name: chart for chart in trade_off.trade_offs(found)}


@pytest.mark.parametrize("name", TABLES)
def test_the_tables_come_out_again(measured, found, name):
    committed = {path.name: path.read_bytes() for path in measured.glob(f"{name}.*")}
    made = {file: content for file, content in files(found.report(name)) if Path(file).stem == name}  # no heat maps
    assert made == committed, "none of a table whose experiment was not run"


def test_the_findings_come_out_again(root, found):
    assert dict(files(found.report("findings"))) == {"findings.md": (root / "docs" / "findings.md").read_bytes()}


def test_the_points_of_all_charts_come_out_again(measured, found, all_trade_offs):
    made = {}
    heat_maps = (part for part in found.report("stability") if isinstance(part, Chart))
    for chart in (*all_trade_offs.values(), *heat_maps, *found.report("sweep"), *found.report("smallest_chart")):
        made[f"{chart.name}.csv"] = csv_text.of_frame(chart.numbers)
    committed = {p.name: p.read_text() for p in measured.glob("*.csv") if p.stem not in TABLES}
    assert committed == made


def test_names_in_the_charts_do_not_touch(all_trade_offs):
    for chart in all_trade_offs.values():
        for panel, texts in trade_off_chart.draw(chart)[1]:
            assert_apart(panel, texts)
            named = {text.get_text().split("\n")[0] for text in texts}
            assert {short(m.point.title, m.point.preset) for m in panel.marks if m.role != "release"} <= named


def test_it_is_small(measured):
    paths = [path for path in measured.rglob("*") if path.is_file()]
    assert len(paths) <= 140 and sum(path.stat().st_size for path in paths) < 20e6
