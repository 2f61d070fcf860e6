"""The committed tables and findings are those of the committed runs."""

import re
from collections import defaultdict
from functools import cache
from pathlib import Path

import pytest
import yaml
from support.made_up import assert_apart

from padgs.multirun.composition import composing, multirun
from padgs.multirun.overrides import expand
from padgs.reports import REPORTS, store
from padgs.reports.charts import trade_off, trade_off_chart
from padgs.reports.frame import frame
from padgs.reports.selection import Mixture, RunSet, separate
from padgs.reports.table import Table
from padgs.reports.writers import files, markdown

OTHERS = ("html", "findings", "smallest_chart")
TABLES = [name for name, report in REPORTS.items() if ".charts." not in report.function and name not in OTHERS]


@pytest.fixture(scope="module")
def measured(root):
    return root / "reports" / "measured"


@pytest.fixture(scope="module")
def stored(measured):
    read, broken = store.read(measured / store.FILE_NAME)
    assert broken == [] and len(read) >= 50
    return read


@pytest.fixture(scope="module")
def found(stored):
    return RunSet(frame(stored))


@pytest.mark.parametrize("name", TABLES)
def test_the_tables_come_out_again(measured, found, name):
    committed = {path.name: path.read_bytes() for path in measured.glob(f"{name}.md")}
    made = found.report(name)
    table = next(part for part in (made if isinstance(made, list) else [made]) if isinstance(part, Table))
    texts = {f"{name}.md": markdown(table).encode()} if table.blocks else {}
    assert texts == committed, "none of a table whose experiment was not run"


def test_the_findings_come_out_again(root, found):
    assert dict(files(found.report("findings"))) == {"findings.md": (root / "docs" / "findings.md").read_bytes()}


def test_every_other_table_and_chart_is_of_a_report(measured):
    names = {Path(file).stem for file in (*measured.glob("*.md"), *measured.glob("*.png"))} - {"README"}
    known = (*TABLES, "equal_time_mean_", "chart_", "time_", "sweep_", "stability-", "smallest_")
    assert all(name in TABLES or name.startswith(known) for name in names)


def test_labels_of_charts_do_not_overlap(found):
    while True:  # runs of several machines are apart, as in the report
        try:
            every = trade_off.trade_offs(found)
            break
        except Mixture as mixture:
            found = RunSet(separate(found.runs, mixture))
    for made in every:
        for panel, _, _, texts in trade_off_chart.draw(made)[1]:
            assert texts
            assert_apart(panel, texts)


def test_it_is_small(measured):
    paths = [path for path in measured.rglob("*") if path.is_file()]
    assert len(paths) <= 60 and sum(path.stat().st_size for path in paths) < 16e6


def promised(readme: Path) -> list[dict[str, str]]:
    """The settings of each run that the README names, and its line under ``line``."""
    found = []
    with composing() as loader:
        for line in re.findall(r"^\w+: (\+.*)$", readme.read_text(), re.MULTILINE):
            config = multirun(["-m", *line.split()])
            for job in expand(config.hydra.sweeper.params or {}, config.hydra.overrides.task, loader):
                settings = (text.lstrip("+").split("=", 1) for text in job if not text.startswith("~"))
                found.append({"line": line, **dict(settings)})
    return found


def by_dotted_keys(config: dict, prefix: str = "") -> dict[str, object]:
    """The values of a configuration."""
    found = {}
    for key, value in config.items():
        found |= by_dotted_keys(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return found


parsed = cache(yaml.safe_load)


def missing(promises: list[dict[str, str]], runs) -> list[dict[str, str]]:
    """The promises without a result."""
    results = defaultdict(list)
    for result in (run.result for run in runs):
        settings = by_dotted_keys(result.config)
        settings |= dict.fromkeys(("ablation", "deviation", "plus_ablation"), result.variant)
        settings |= dict.fromkeys(("data.width", "data.generator.width"), result.width)
        scene = result.scene.replace("-", "_").removeprefix("synthetic_room_").removesuffix("_other_path")
        settings |= {
            "data.path": result.scene,
            "scene": scene,
            "method": result.preset,
            "smallest": bool(result.smallest),
        }
        for name in result.experiments:
            results[name.partition("@")[0]].append(settings)
    not_settings = ("line", "experiment", "sweep", "scale")

    def kept(promise: dict[str, str]) -> bool:
        wanted = {key: parsed(text) for key, text in promise.items() if key not in not_settings}
        if wanted.get("stress.condition") == "none":
            wanted |= {"stress.condition": None, "stress.level": None}
        found = results["smallest" if "smallest" in promise else promise.get("experiment") or promise["sweep"]]
        return any(all(settings.get(key) == value for key, value in wanted.items()) for settings in found)

    return [promise for promise in promises if not kept(promise)]


def test_every_run_that_the_readme_names_is_there(measured, stored):
    promises = promised(measured / "README.md")
    assert len(promises) > 1000
    assert missing(promises, stored) == []
    capacity = [promise for promise in promises if promise.get("experiment") == "capacity"]
    assert missing(capacity, [run for run in stored if "capacity" not in run.result.experiments]) == capacity != []
