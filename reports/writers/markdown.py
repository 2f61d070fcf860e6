"""A table as GitHub Markdown: one table per block, the best number of each column in bold, the second underlined."""

from __future__ import annotations

from padgs.reports.tables.ranking import BEST, emphasis
from padgs.reports.tables.table import Block, Table


def text(table: Table) -> str:
    """The whole table with its title and footnotes."""
    parts = [f"## {_plain(table.title)}"]
    for block in table.blocks:
        alone = table.alone(block)
        parts.append(f"### {_plain(block.title)}\n\n{_block(alone, alone.blocks[0])}")
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
        title, *shown = map(_escaped, row.texts(table.columns))
        marked = [_marked(words, rank.get(number)) for words, rank in zip(shown, ranks, strict=True)]
        lines.append(_line([title, *marked]))
    return "\n".join(lines)


def _marked(words: str, rank: str | None) -> str:
    return words if rank is None else f"**{words}**" if rank == BEST else f"<ins>{words}</ins>"


def _line(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _plain(words: str) -> str:
    """A line without HTML, and without what a terminal would obey."""
    return "".join(c if c.isprintable() else " " for c in words).replace("<", "&lt;")


def _escaped(words: str) -> str:
    return _plain(words).replace("|", "\\|").replace("*", "\\*").replace("_", "\\_")
