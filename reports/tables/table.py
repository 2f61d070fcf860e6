"""What a table is before anyone writes it down: columns, blocks of rows, cells that may be missing, and footnotes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

MISSING = "–"
UNRANKED = "†"  # after the title of a row whose numbers compete with no other's; a note says why


class ReportError(ValueError):
    """A table that must not be made from these results; the message says why and what to do."""


@dataclass(frozen=True)
class Column:
    """How the numbers of a column are read."""

    title: str
    decimals: int
    higher_is_better: bool | None = None  # None: neither end is best
    signed: bool = False  # a difference: always with its sign
    group: str = ""  # heading over neighbouring columns
    optional: bool = False  # left out of a block that has nothing in it, where blocks stand as tables of their own

    @property
    def heading(self) -> str:
        """The title with an arrow towards the better end."""
        return self.title + {True: " ↑", False: " ↓", None: ""}[self.higher_is_better]


@dataclass(frozen=True)
class Cell:
    """A number with its spread over seeds, or the reason why there is none."""

    value: float | None = None
    std: float | None = None  # over seeds; None for a single run
    count: int = 1
    status: str = ""  # of failed runs: oom, nan, ...
    ranked: bool = True  # whether it may stand out among the others of its column

    @property
    def numbers(self) -> dict[str, Any]:
        """All that it knows, for a file of numbers."""
        count = None if self.value is None else self.count
        return {"value": self.value, "std": self.std, "n": count, "status": self.status}

    def text(self, column: Column, *, counted: bool = True) -> str:
        """What stands in the cell, without emphasis; `counted`: with the number of seeds.

        >>> Cell(26.018, 0.04, 5).text(Column("PSNR", 2)), Cell(status="oom").text(Column("PSNR", 2))
        ('26.02 ± 0.04 (n=5)', 'OOM')
        """
        if self.value is None:
            return self.status.upper() or MISSING
        text = shown(self.value, column)
        if self.std is not None:
            text += f" ± {self.std:.{column.decimals}f}" + (f" (n={self.count})" if counted else "")
        return text + (f" [{self.status.upper()}]" if self.status else "")


@dataclass(frozen=True)
class Row:
    """One line; a cell for each column."""

    title: str
    cells: tuple[Cell, ...]

    def texts(self, columns: Sequence[Column]) -> list[str]:
        """The title and the cells as they stand; the number of seeds is said once where all spreads are over as many.

        >>> Row("PaD-GS", (Cell(26.018, 0.04, 5), Cell(0.8, 0.01, 5))).texts([Column("PSNR", 2), Column("SSIM", 3)])
        ['PaD-GS (n=5)', '26.02 ± 0.04', '0.800 ± 0.010']
        """
        counts = {cell.count for cell in self.cells if cell.std is not None}
        title = self.title if all(cell.ranked for cell in self.cells) else f"{self.title} {UNRANKED}"
        title += f" (n={min(counts)})" if len(counts) == 1 else ""
        cells = zip(self.cells, columns, strict=True)
        return [title, *(cell.text(column, counted=len(counts) > 1) for cell, column in cells)]


@dataclass(frozen=True)
class Block:
    """Rows that are compared with each other, such as those of one scene."""

    title: str
    rows: tuple[Row, ...]
    signed: bool = False  # differences or correlations: numbers have their sign, and none is the best

    def reads(self, columns: Sequence[Column]) -> tuple[Column, ...]:
        """The columns of the table as they are meant here."""
        if not self.signed:
            return tuple(columns)
        return tuple(replace(column, signed=True, higher_is_better=None) for column in columns)


@dataclass(frozen=True)
class Table:
    """A whole table; `corner` is the heading over the titles of the rows."""

    name: str  # table3; the file name and the LaTeX label
    title: str
    corner: str
    columns: tuple[Column, ...]
    blocks: tuple[Block, ...]
    notes: tuple[str, ...] = field(default=())

    def alone(self, block: Block, *, every: bool = False) -> Table:
        """One block as a table of its own, without the optional columns (or `every` column) that it has nothing in."""
        kept = [
            index
            for index, column in enumerate(self.columns)
            if not (column.optional or every) or any(row.cells[index] != Cell() for row in block.rows)
        ]
        rows = tuple(Row(row.title, tuple(row.cells[index] for index in kept)) for row in block.rows)
        columns = block.reads([self.columns[index] for index in kept])
        return replace(self, columns=columns, blocks=(replace(block, rows=rows),))


def shown(value: float, column: Column) -> str:
    """A number as it stands in a column."""
    if not math.isfinite(value):
        return str(value)
    return f"{value:{'+' if column.signed else ''}.{column.decimals}f}"
