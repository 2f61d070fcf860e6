"""A table as data: columns, blocks of rows, cells that may be missing, and footnotes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress
from typing import Any

MISSING = "–"
UNRANKED = "†"  # after the title of a row that competes with no other; a note says why


class ReportError(ValueError):
    """A report cannot be made from these results; the message says why and what to do."""


@dataclass(frozen=True)
class Column:
    """Title, format and direction of a column."""

    title: str
    decimals: int
    higher_is_better: bool | None = None  # None: neither end is best
    signed: bool = False  # a difference: always with its sign
    group: str = ""  # heading over neighbouring columns
    optional: bool = False  # dropped from a block in which it is empty

    @property
    def heading(self) -> str:
        """Title with an arrow towards the better end."""
        return self.title + {True: " ↑", False: " ↓", None: ""}[self.higher_is_better]


@dataclass(frozen=True)
class Cell:
    """A number with its standard deviation over seeds, or the reason why it is missing."""

    value: float | None = None
    std: float | None = None  # None for a single run
    count: int = 1  # of seeds; 0: of no runs of ours, as limits, ranks and published numbers
    status: str = ""  # of failed runs: oom, nan, ...
    ranked: bool = True  # False: shown, but never highlighted

    @property
    def numbers(self) -> dict[str, Any]:
        """Fields of a line of a CSV file."""
        count = None if self.value is None else self.count or None
        return {"value": self.value, "std": self.std, "n": count, "status": self.status}

    def text(self, column: Column, *, counted: bool = True) -> str:
        """Return the text of the cell without emphasis; `counted`: with the number of seeds.

        >>> Cell(26.018, 0.04, 5).text(Column("PSNR", 2)), Cell(status="oom").text(Column("PSNR", 2))
        ('26.02 ± 0.04 (n=5)', 'OOM')
        """
        if self.value is None:
            return self.status.upper() or MISSING
        text = format_number(self.value, column)
        text += "" if self.std is None else f" ± {self.std:.{column.decimals}f}"
        text += f" (n={self.count})" if counted and self.count else ""
        return text + (f" [{self.status.upper()}]" if self.status else "")


@dataclass(frozen=True)
class Row:
    """A line with a cell for each column."""

    title: str
    cells: tuple[Cell, ...]
    signed: bool = False  # differences

    def texts(self, columns: Sequence[Column]) -> list[str]:
        """Return title and cells as text; a number of seeds that all cells share moves to the title, if it is not one.

        >>> Row("PaD-GS", (Cell(26.018, 0.04, 5), Cell(0.8, 0.01, 5))).texts([Column("PSNR", 2), Column("SSIM", 3)])
        ['PaD-GS (n=5)', '26.02 ± 0.04', '0.800 ± 0.010']
        """
        known = [cell for cell in self.cells if cell.value is not None]
        counts = {cell.count for cell in known if cell.count}
        unranked = bool(known) and not any(cell.ranked for cell in known)
        title = f"{self.title} {UNRANKED}" if unranked else self.title
        title += f" (n={min(counts)})" if len(counts) == 1 and counts != {1} else ""
        columns = [replace(column, signed=True) for column in columns] if self.signed else columns
        texts = (cell.text(column, counted=len(counts) > 1) for cell, column in zip(self.cells, columns, strict=True))
        marks = ("" if unranked or cell.ranked else f" {UNRANKED}" for cell in self.cells)
        return [title, *map("".join, zip(texts, marks, strict=True))]


@dataclass(frozen=True)
class Block:
    """Rows that are compared with each other, such as those of one scene."""

    title: str
    rows: tuple[Row, ...]
    own_columns: tuple[Column, ...] = ()  # instead of the table's
    across: Column | None = None  # all cells are of this column, and the best is sought within each row


@dataclass(frozen=True)
class Table:
    """A whole table; `corner` is the heading over the titles of the rows."""

    name: str  # file name and LaTeX label
    title: str
    corner: str
    columns: tuple[Column, ...]
    blocks: tuple[Block, ...]
    notes: tuple[str, ...] = ()

    def single(self, block: Block, *, drop_empty: bool = False) -> Table:
        """Return one block as a table without empty optional columns, or with `drop_empty` without any empty column."""
        every = block.own_columns or self.columns
        known = [any(row.cells[index] != Cell() for row in block.rows) for index in range(len(every))]
        kept = [is_known or not (of.optional or drop_empty) for is_known, of in zip(known, every, strict=True)]
        rows = tuple(replace(row, cells=tuple(compress(row.cells, kept))) for row in block.rows)
        columns, corner = tuple(compress(every, kept)), "Scene" if block.across else self.corner
        return replace(self, corner=corner, columns=columns, blocks=(replace(block, rows=rows, own_columns=()),))


def format_number(value: float, column: Column) -> str:
    """Return a number as text in the format of a column."""
    if not math.isfinite(value):
        return str(value)
    return f"{value:{'+' if column.signed else ''}.{column.decimals}f}"
