"""What is written for each report: names and contents of files."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from reports.charts import sweeps, trade_off
from reports.charts.drawing import Chart
from reports.gathered import Gathered
from reports.page import page
from reports.writers import csv_text, latex, markdown

File = tuple[str, bytes]  # name, content
WRITERS = {"md": markdown.text, "tex": latex.text, "csv": csv_text.text}


def _table(gathered: Gathered, name: str) -> Iterator[File]:
    table = gathered.table(name)
    for extension, text in WRITERS.items() if table.blocks else ():
        yield f"{name}.{extension}", text(table).encode()


table1, table2, table3, table4, methods, equal_time, ladder, quirks, runs = (
    partial(_table, name=name)
    for name in ("table1", "table2", "table3", "table4", "methods", "equal_time", "ladder", "quirks", "runs")
)


def sweep(gathered: Gathered) -> Iterator[File]:
    """Curves of every sweep as pictures, and their points."""
    for made, chart in gathered.sweeps:
        yield from _pictures(chart)
        yield f"{made.file_name}.csv", sweeps.csv_text(made).encode()


def chart(gathered: Gathered) -> Iterator[File]:
    """Speed against accuracy, quality over training time, and the points of the first."""
    for made, charts in gathered.trade_offs:
        for drawn in charts:
            yield from _pictures(drawn)
        yield f"{made.name}.csv", trade_off.csv_text(made).encode()


def html(gathered: Gathered) -> Iterator[File]:
    """The page with everything."""
    yield "report.html", page.text(gathered).encode()


def _pictures(chart: Chart) -> Iterator[File]:
    yield f"{chart.name}.svg", chart.svg.encode()
    yield f"{chart.name}.png", chart.png
