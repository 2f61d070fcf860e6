"""A table as GitHub Markdown: one table per block, the best number of each column in bold, the second underlined."""

from __future__ import annotations

from reports.ranking import BEST, emphasis
from reports.table import Block, Table


def text(table: Table) -> str:
    """The whole table with its title and footnotes."""
    parts = [f"## {table.title}"]
    for block in table.blocks:
        alone = table.alone(block)
        parts.append(f"### {block.title}\n\n{_block(alone, alone.blocks[0])}")
    if table.notes:
        parts.append("\n".join(f"- {_escaped(note)}" for note in table.notes))
    return "\n\n".join(parts) + "\n"


def _block(table: Table, block: Block) -> str:
    ranks = [emphasis(block, index, table.columns) for index in range(len(table.columns))]
    lines = [
        _line([table.corner, *(column.heading for column in table.columns)]),
        _line(["---", *("---:" for _ in table.columns)]),
    ]
    for number, row in enumerate(block.rows):
        cells = []
        for index, (cell, column) in enumerate(zip(row.cells, table.columns, strict=True)):
            shown = _escaped(cell.text(column))
            rank = ranks[index].get(number)
            cells.append(shown if rank is None else f"**{shown}**" if rank == BEST else f"<ins>{shown}</ins>")
        lines.append(_line([_escaped(row.title), *cells]))
    return "\n".join(lines)


def _line(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _escaped(words: str) -> str:
    return words.replace("|", "\\|").replace("*", "\\*").replace("_", "\\_")
