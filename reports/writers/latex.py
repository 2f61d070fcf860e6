"""A table as LaTeX with booktabs: blocks under each other, the best of each column in bold, the second underlined."""

from __future__ import annotations

from itertools import groupby

from reports.tables.ranking import BEST, emphasis
from reports.tables.table import Block, Table

SPECIAL = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
SPECIAL |= {character: f"\\{character}" for character in "&%$#_{}"}
SYMBOLS = {"↑": r"$\uparrow$", "↓": r"$\downarrow$", "Δ": r"$\Delta$", "±": r"$\pm$", "–": "--", "×": r"$\times$"}
SYMBOLS |= {"†": r"\dag{}"}
SYMBOLS |= {"τ": r"$\tau$", "√": r"$\surd$"}


LINES_OF_A_PAGE = 55


def text(table: Table) -> str:
    """A `table`, made as narrow as the line, or a `longtable` where a page is too short; needs the packages named."""
    body = [line for block in table.blocks for line in _block(block, table)]
    whole = _longtable if len(body) > LINES_OF_A_PAGE else _float
    return "\n".join(whole(table, body)) + "\n"


def _float(table: Table, body: list[str]) -> list[str]:
    notes = " ".join(escaped(note) for note in table.notes)
    return [
        "% needs \\usepackage{booktabs, graphicx}",
        r"\begin{table}",
        r"  \centering",
        f"  {_caption(table)}",
        r"  \resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%",
        f"  \\begin{{tabular}}{{l{'r' * len(table.columns)}}}",
        r"    \toprule",
        *_headings(table),
        *body,
        r"    \bottomrule",
        r"  \end{tabular}}",
        f"  \\par\\smallskip\\begin{{minipage}}{{\\linewidth}}\\footnotesize {notes}\\end{{minipage}}",
        r"\end{table}",
    ]


def _longtable(table: Table, body: list[str]) -> list[str]:
    return [
        "% needs \\usepackage{booktabs, longtable}",
        r"\begingroup\scriptsize\setlength{\tabcolsep}{2pt}",
        f"\\begin{{longtable}}{{l{'r' * len(table.columns)}}}",
        f"  {_caption(table)} \\\\",
        r"    \toprule",
        *_headings(table),
        r"    \endhead",
        *body,
        r"    \bottomrule",
        r"\end{longtable}",
        *(f"\\noindent {escaped(note)}\\par" for note in table.notes),
        r"\endgroup",
    ]


def _caption(table: Table) -> str:
    return f"\\caption{{{escaped(table.title)}}}\\label{{tab:{table.name}}}"


def _block(block: Block, table: Table) -> list[str]:
    columns = block.reads(table.columns)
    ranks = [emphasis(block, index, columns) for index in range(len(columns))]
    title = f"\\multicolumn{{{len(columns) + 1}}}{{l}}{{\\emph{{{escaped(block.title)}}}}}"
    lines = [r"    \midrule", _line([title])]
    for number, row in enumerate(block.rows):
        title, *texts = row.texts(columns)
        cells = [escaped(title)]
        for words, ranked in zip(texts, ranks, strict=True):
            shown, rank = _number(words), ranked.get(number)
            command = None if rank is None else "textbf" if rank == BEST else "underline"
            cells.append(shown if command is None else f"\\{command}{{{shown}}}")
        lines.append(_line(cells))
    return lines


def escaped(words: str) -> str:
    """Text that LaTeX prints as it is.

    >>> escaped("50 % of a_b ↑")
    '50 \\\\% of a\\\\_b $\\\\uparrow$'
    """
    words = "".join(c if c.isprintable() else " " for c in words)  # an empty line would end a caption
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
    mean, plus_minus, spread = shown.partition(" ± ")
    text = f"${mean[0]}${mean[1:]}" if mean[:1] in ("+", "-") else escaped(mean)
    return f"{text}{{\\tiny\\,$\\pm$\\,{escaped(spread)}}}" if plus_minus else text


def _line(cells: list[str]) -> str:
    guard = "{}" if cells[0][:1] in ("[", "*") else ""  # which the end of the line above would take for its own
    return f"    {guard}{' & '.join(cells)} \\\\"
