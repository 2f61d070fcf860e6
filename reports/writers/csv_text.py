"""A table as CSV, one line per cell and all digits, for whoever computes with it."""

from __future__ import annotations

import csv
import io

from reports.tables.ranking import emphasis
from reports.tables.table import Table

HEADER = ("table", "block", "row", "group", "column", "value", "std", "n", "status", "rank")


def text(table: Table) -> str:
    """All cells; `value` is empty where there is no number, `status` says why."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(HEADER)
    for block in table.blocks:
        ranks = [emphasis(block, index, table.columns) for index in range(len(table.columns))]
        for number, row in enumerate(block.rows):
            for cell, column, rank in zip(row.cells, table.columns, ranks, strict=True):
                count = "" if cell.value is None else cell.count
                place = (table.name, block.title, row.title, column.group, column.title)
                writer.writerow((*place, cell.value, cell.std, count, cell.status, rank.get(number, "")))
    return file.getvalue()
