"""A table as LaTeX with booktabs: blocks under each other, the best of each column in bold, the second underlined."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

from padgs.reports.tables.ranking import BEST, emphasis
from padgs.reports.tables.table import Block, Table

SPECIAL = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
SPECIAL |= {character: f"\\{character}" for character in "&%$#_{}"}
SYMBOLS = {"↑": r"$\uparrow$", "↓": r"$\downarrow$", "Δ": r"$\Delta$", "±": r"$\pm$", "–": "--", "×": r"$\times$"}
SYMBOLS |= {"†": r"\dag{}"}
SYMBOLS |= {"τ": r"$\tau$", "√": r"$\surd$"}


LINES_OF_A_PAGE = 40
COLUMNS_OF_A_PAGE = 12  # upright


def text(table: Table) -> str:
    """A `table` for each page that it takes, made as narrow as the line, turned where it is wide; needs the packages
    named. Notes are below it, or after the last one.
    """
    pages = _pages([_block(block, table) for block in table.blocks])
    wide, alone = len(table.columns) > COLUMNS_OF_A_PAGE, len(pages) == 1
    lines = [f"% needs \\usepackage{{booktabs, graphicx{', pdflscape' if wide else ''}}}"]
    for number, page in enumerate(pages):
        made = _float(table, page, number, table.notes if alone else ())
        lines += (
            [r"\begin{landscape}", *made, r"\end{landscape}"] if wide else made if alone else [*made, r"\clearpage"]
        )
    if not alone:
        lines += [
            r"\begingroup\scriptsize",
            *(f"\\noindent {escaped(note)}\\par" for note in table.notes),
            r"\endgroup",
        ]
    return "\n".join(lines) + "\n"


def _pages(blocks: list[list[str]]) -> list[list[str]]:
    """The lines of each page; a block is cut only if it is longer than that."""
    pages: list[list[str]] = [[]]
    for block in blocks:
        for start in range(0, len(block), LINES_OF_A_PAGE):
            part = block[start : start + LINES_OF_A_PAGE]
            if pages[-1] and len(pages[-1]) + len(part) > LINES_OF_A_PAGE:
                pages.append([])
            pages[-1] += part
    return pages


def _float(table: Table, body: list[str], page: int, notes: Sequence[str]) -> list[str]:
    words = " ".join(map(escaped, notes))
    return [
        r"\begin{table}",
        r"  \centering",
        f"  {_continued(table) if page else _caption(table)}",
        r"  \resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%",
        f"  \\begin{{tabular}}{{l{'r' * len(table.columns)}}}",
        r"    \toprule",
        *_headings(table),
        *body,
        r"    \bottomrule",
        r"  \end{tabular}}",
        *(
            [f"  \\par\\smallskip\\begin{{minipage}}{{\\linewidth}}\\footnotesize {words}\\end{{minipage}}"]
            if notes
            else []
        ),
        r"\end{table}",
    ]


def _continued(table: Table) -> str:
    return f"\\addtocounter{{table}}{{-1}}\\caption[]{{{escaped(table.title)}, continued}}"


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
