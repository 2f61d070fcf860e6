"""A table as LaTeX with booktabs: blocks under each other, best number of each column in bold."""

from __future__ import annotations

from itertools import groupby

from reports.table import Table, best_rows

SPECIAL = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
SPECIAL |= {character: f"\\{character}" for character in "&%$#_{}"}
SYMBOLS = {"↑": r"$\uparrow$", "↓": r"$\downarrow$", "Δ": r"$\Delta$", "±": r"$\pm$", "–": "--", "×": r"$\times$"}


def text(table: Table) -> str:
    """A `table` environment; needs the package booktabs."""
    width = len(table.columns) + 1
    lines = [
        "% needs \\usepackage{booktabs}",
        r"\begin{table}",
        r"  \centering",
        f"  \\caption{{{escaped(table.title)}}}",
        f"  \\label{{tab:{table.name}}}",
        f"  \\begin{{tabular}}{{l{'r' * len(table.columns)}}}",
        r"    \toprule",
        *_headings(table),
    ]
    for block in table.blocks:
        best = [best_rows(block, index, table.columns) for index in range(len(table.columns))]
        lines += [r"    \midrule", f"    \\multicolumn{{{width}}}{{l}}{{\\emph{{{escaped(block.title)}}}}} \\\\"]
        for number, row in enumerate(block.rows):
            cells = [escaped(row.title)]
            for index, (cell, column) in enumerate(zip(row.cells, table.columns, strict=True)):
                shown = _number(cell.text(column))
                cells.append(f"\\textbf{{{shown}}}" if number in best[index] else shown)
            lines.append(_line(cells))
    lines += [r"    \bottomrule", r"  \end{tabular}"]
    if table.notes:
        notes = " ".join(escaped(note) for note in table.notes)
        lines += [f"  \\par\\smallskip\\begin{{minipage}}{{\\linewidth}}\\footnotesize {notes}\\end{{minipage}}"]
    return "\n".join([*lines, r"\end{table}"]) + "\n"


def escaped(words: str) -> str:
    """Text that LaTeX prints as it is.

    >>> escaped("50 % of a_b ↑")
    '50 \\\\% of a\\\\_b $\\\\uparrow$'
    """
    return "".join(SPECIAL.get(character) or SYMBOLS.get(character, character) for character in words)


def _headings(table: Table) -> list[str]:
    lines, rules, first = [], [], 2
    groups = [(group, len(list(columns))) for group, columns in groupby(table.columns, lambda column: column.group)]
    if any(group for group, _ in groups):
        cells = [""]
        for group, size in groups:
            cells.append(f"\\multicolumn{{{size}}}{{c}}{{{escaped(group)}}}")
            rules.append(f"\\cmidrule(lr){{{first}-{first + size - 1}}}" if group else "")
            first += size
        lines += [_line(cells), f"    {''.join(rules)}"]
    return [*lines, _line([escaped(table.corner), *(escaped(column.heading) for column in table.columns)])]


def _number(shown: str) -> str:
    return f"${shown[0]}${shown[1:]}" if shown[:1] in ("+", "-") else escaped(shown)


def _line(cells: list[str]) -> str:
    return f"    {' & '.join(cells)} \\\\"
