"""The committed tables are those of the committed runs: nobody typed a number."""

import pytest
from made_up import assert_apart

from padgs.reports import REPORTS, store
from padgs.reports.charts import trade_off, trade_off_chart
from padgs.reports.charts.drawing import Chart
from padgs.reports.frame import frame
from padgs.reports.methods import short
from padgs.reports.selection import RunSet

TABLES = [name for name, report in REPORTS.items() if report.function.startswith("padgs.reports.tables.")]


@pytest.fixture(scope="module")
def measured(root):
    return root / "reports" / "measured"


@pytest.fixture(scope="module")
def found(measured):
    read, broken = store.read(measured / store.FILE_NAME)
    assert broken == [] and len(read) >= 50
    return RunSet(frame(read))


@pytest.fixture(scope="module")
def all_trade_offs(found):
    return {chart.name: chart for chart in trade_off.trade_offs(found)}


@pytest.mark.parametrize("name", TABLES)
def test_the_tables_come_out_again(measured, found, name):
    committed = {path.name: path.read_bytes() for path in measured.glob(f"{name}.*")}
    made = {}
    heat_maps = (part for part in found.report("stability") if isinstance(part, Chart))
    for chart in (*all_trade_offs.values(), *heat_maps, *found.report("sweep"), *found.report("smallest_chart")):
        made[f"{chart.name}.csv"] = chart.numbers.to_csv(index=False, lineterminator="\n")
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
