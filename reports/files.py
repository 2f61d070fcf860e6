"""What is written of each report: names and contents of files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from padgs.reports.charts.drawing import Chart
from padgs.reports.findings.page import Page
from padgs.reports.tables.table import Table
from padgs.reports.writers import csv_text, latex, markdown
from padgs.results import file_name

WRITERS = {"md": markdown.text, "tex": latex.text, "csv": csv_text.text}


def files(made: Table | Page | Chart | Sequence[Table | Chart] | str, svg: bool = False) -> Iterator[tuple[str, bytes]]:
    """The files of a table, a chart or a page, or of several; none of a table that has nothing in it.

    Names of charts are those of scenes and sweeps, which may come from elsewhere; a file is in its folder all the same.
    """
    if isinstance(made, str):
        yield "report.html", made.encode()
    elif isinstance(made, Page):
        yield made.name, made.text.encode()
    elif isinstance(made, Table):
        for extension, text in WRITERS.items() if made.blocks else ():
            yield f"{made.name}.{extension}", text(made).encode()
    elif isinstance(made, Chart):
        name = file_name(made.name)
        yield f"{name}.png", made.png
        if svg:
            yield f"{name}.svg", made.svg.encode()
        if made.numbers is not None:
            yield f"{name}.csv", csv_text.of_frame(made.numbers).encode()
    else:
        for part in made:
            yield from files(part, svg)
