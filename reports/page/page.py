"""One page with everything, in one file that needs no network: tables that sort, charts, pictures and a 360° viewer."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any

from pandas import DataFrame

from padgs.reports import REPORTS
from padgs.reports.charts.drawing import Chart
from padgs.reports.gathered import Gathered
from padgs.reports.page.pictures import album
from padgs.reports.tables.beside_paper import OF_THE_PAPER
from padgs.reports.tables.ranking import BEST, emphasis
from padgs.reports.tables.table import Block, Cell, ReportError, Table

HERE = Path(__file__).resolve().parent
SCRIPTS = ("pannellum.js", "tablesort.min.js", "tablesort.number.min.js", "img-comparison-slider.js")
STYLES = ("pannellum.css", "img-comparison-slider.css")
LOWEST = "-1e99"  # where a cell without a number is sorted


def html(gathered: Gathered) -> str:
    """The page with all other reports."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(HERE), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    refused: list[str] = []
    made = {name: _attempt(gathered, name, refused) for name in REPORTS if name not in ("html", "gallery")}
    parts = [part for report in made.values() for part in (report if isinstance(report, list) else [report])]
    tables = [table for part in parts if isinstance(part, Table) and (table := _measured(part)).blocks]
    maps = [part for part in made["stability"] or () if isinstance(part, Chart)]
    pictures = album(gathered)
    return environment.get_template("page.html.j2").render(
        facts=_facts(gathered.runs),
        problems=[*gathered.left_out, *refused, *gathered.warnings],
        tables=[_table(table) for table in tables],
        maps=[_chart(chart) for chart in maps],
        charts=[_chart(chart) for name in ("chart", "need_chart") for chart in made[name] or ()],
        sweeps=[_chart(chart) for chart in made["sweep"] or ()],
        pictures=pictures,
        data=_script(json.dumps({"images": pictures.images, "scenes": pictures.scenes})),
        styles="\n".join([*(_vendored(name) for name in STYLES), (HERE / "page.css").read_text()]),
        scripts=[*(_vendored(name) for name in SCRIPTS), (HERE / "page.js").read_text()],
        notice=_vendored("NOTICE.md"),
    )


def _attempt(gathered: Gathered, name: str, refused: list[str]) -> Any:
    """A report that can be made; else None, with the reason kept for the page."""
    try:
        return gathered.report(name)
    except ReportError as error:
        refused.append(str(error))
        return None


def _facts(runs: DataFrame) -> list[tuple[str, str]]:
    columns = {"Scenes": "scene", "Methods": "preset", "Code": "code_version", "Machines": "hardware"}
    facts = [("Runs", f"{len(runs)}, of which {(~runs['ok']).sum()} failed")]
    facts += [(name, ", ".join(sorted(runs[column].unique()))) for name, column in columns.items()]
    return [*facts, ("Last run", max(runs["finished"], default="none"))]


def _measured(table: Table) -> Table:
    """A table without the blocks in which nothing but published numbers stand: of data sets that were not run."""
    ours = [index for index, column in enumerate(table.columns) if column.title not in OF_THE_PAPER]
    blocks = (
        block for block in table.blocks if any(row.cells[index] != Cell() for row in block.rows for index in ours)
    )
    return replace(table, blocks=tuple(blocks))


def _table(table: Table) -> dict[str, Any]:
    return {
        "name": table.name,
        "title": table.title,
        "corner": table.corner,
        "blocks": [_block(table.alone(block, every=True)) for block in table.blocks],
        "notes": table.notes,
    }


def _block(table: Table) -> dict[str, Any]:
    (block,) = table.blocks
    groups = [(group, len(list(columns))) for group, columns in groupby(table.columns, lambda column: column.group)]
    return {
        "title": block.title,
        "groups": groups if any(size > 1 for _, size in groups) else [],
        "headings": [column.heading for column in table.columns],
        "rows": _rows(table, block),
    }


def _rows(table: Table, block: Block) -> list[dict[str, Any]]:
    ranks = [emphasis(block, index, table.columns) for index in range(len(table.columns))]
    rows = []
    for number, row in enumerate(block.rows):
        title, *texts = row.texts(table.columns)
        cells = [
            {"text": words, "sort": _sort(cell), "mark": _mark(rank.get(number))}
            for words, cell, rank in zip(texts, row.cells, ranks, strict=True)
        ]
        rows.append({"title": title, "cells": cells})
    return rows


def _sort(cell: Cell) -> str:
    return LOWEST if cell.value is None else f"{cell.value:.9f}"


def _mark(rank: str | None) -> str:
    return "" if rank is None else "best" if rank == BEST else "second"


def _chart(chart: Chart) -> dict[str, Any]:
    """A chart for a page, and for a phone where it has such a picture."""
    sizes = {"wide": chart.svg, "narrow": chart.narrow} if chart.narrow else {"": chart.svg}
    pictures = {size: svg[svg.index("<svg") :] for size, svg in sizes.items()}  # the lines before are for a file
    return {"title": chart.title, "pictures": pictures, "notes": chart.notes}


def _script(text: str) -> str:
    """JSON that cannot end the script element around it."""
    return text.replace("<", "\\u003c")


def _vendored(name: str) -> str:
    return (HERE / "vendor" / name).read_text()
