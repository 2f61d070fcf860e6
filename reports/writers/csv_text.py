"""A table as CSV, one line per cell and all digits, for whoever computes with it."""

from __future__ import annotations

from pandas import DataFrame

from padgs.reports.tables.ranking import emphasis
from padgs.reports.tables.table import Table


def text(table: Table) -> str:
    """All cells; `value` is empty where there is no number, `status` says why."""
    return of_frame(cells(table))


def cells(table: Table) -> DataFrame:
    """A row a cell."""
    rows = []
    for block in table.blocks:
        columns = block.reads(table.columns)
        ranks = [emphasis(block, index, columns) for index in range(len(columns))]
        for number, row in enumerate(block.rows):
            for cell, column, rank in zip(row.cells, columns, ranks, strict=True):
                place = {"table": table.name, "block": block.title, "row": row.title}
                place |= {"group": column.group, "column": column.title}
                rows.append({**place, **cell.numbers, "rank": rank.get(number, "")})
    return DataFrame(rows, dtype=object)


def of_frame(frame: DataFrame) -> str:
    """A frame of such rows, without its index."""
    return frame.to_csv(index=False, lineterminator="\n")
