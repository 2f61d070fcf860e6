"""The committed tables and findings are those of the committed runs."""

from pathlib import Path

import pytest
from support.made_up import assert_apart

from padgs.reports import REPORTS, store
from padgs.reports.charts import trade_off, trade_off_chart
from padgs.reports.frame import frame
from padgs.reports.methods import short
from padgs.reports.selection import RunSet
from padgs.reports.writers import files

TABLES = [
    name for name, report in REPORTS.items() if ".charts." not in report.function and name not in ("html", "findings")
]


@pytest.fixture(scope="module")
def measured(root):
    return root / "reports" / "measured"


@pytest.fixture(scope="module")
def found(measured):
    read, broken = store.read(measured / store.FILE_NAME)
    assert broken == [] and len(read) >= 50
    return RunSet(frame(read))


@pytest.mark.parametrize("name", TABLES)
def test_the_tables_come_out_again(measured, found, name):
    committed = {path.name: path.read_bytes() for path in measured.glob(f"{name}.md")}
    made = {file: content for file, content in files(found.report(name)) if file == f"{name}.md"}
    assert made == committed, "none of a table whose experiment was not run"


def test_the_findings_come_out_again(root, found):
    assert dict(files(found.report("findings"))) == {"findings.md": (root / "docs" / "findings.md").read_bytes()}


def test_every_other_table_and_chart_is_of_a_report(measured):
    names = {Path(file).stem for file in (*measured.glob("*.md"), *measured.glob("*.png"))} - {"README", "bench_cpu"}
    known = (*TABLES, "chart_", "time_", "sweep_", "stability-", "robustness-", "smallest_")
    assert all(name in TABLES or name.startswith(known) for name in names)


def test_labels_of_charts_do_not_overlap(found):
    for chart in trade_off.trade_offs(found):
        for panel, texts in trade_off_chart.draw(chart)[1]:
            assert_apart(panel, texts)
            named = {text.get_text().split("\n")[0] for text in texts}
            assert {short(m.point.title, m.point.preset) for m in panel.marks if m.role != "release"} <= named


def test_it_is_small(measured):
    paths = [path for path in measured.rglob("*") if path.is_file()]
    assert len(paths) <= 60 and sum(path.stat().st_size for path in paths) < 15e6
