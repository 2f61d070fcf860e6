"""A table as GitHub Markdown: one table per block, best number of each column in bold."""

from __future__ import annotations

from reports.table import Block, Table, best_rows


def text(table: Table) -> str:
    """The whole table with its title and footnotes."""
    parts = [f"## {table.title}"]
    for block in table.blocks:
        parts.append(f"### {block.title}\n\n{_block(table, block)}")
    if table.notes:
        parts.append("\n".join(f"- {_escaped(note)}" for note in table.notes))
    return "\n\n".join(parts) + "\n"


def _block(table: Table, block: Block) -> str:
    best = [best_rows(block, index, table.columns) for index in range(len(table.columns))]
    lines = [
        _line([table.corner, *(column.heading for column in table.columns)]),
        _line(["---", *("---:" for _ in table.columns)]),
    ]
    for number, row in enumerate(block.rows):
        cells = []
        for index, (cell, column) in enumerate(zip(row.cells, table.columns, strict=True)):
            shown = _escaped(cell.text(column))
            cells.append(f"**{shown}**" if number in best[index] else shown)
        lines.append(_line([_escaped(row.title), *cells]))
    return "\n".join(lines)


def _line(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _escaped(words: str) -> str:
    return words.replace("|", "\\|").replace("*", "\\*").replace("_", "\\_")
