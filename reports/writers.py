"""Files of a report: Markdown, LaTeX and CSV of tables, PNG, SVG and CSV of charts, and pages."""

import hashlib
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

from pandas import DataFrame
from PIL import Image

from padgs.files import file_name
from padgs.reports.charts.drawing import Chart
from padgs.reports.significance import BEST, marks
from padgs.reports.table import Table

SPECIAL = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
SPECIAL |= {character: f"\\{character}" for character in "&%$#_{}"}
SPECIAL |= {"<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", '"': "''"}
SPECIAL |= {"↑": r"$\uparrow$", "↓": r"$\downarrow$", "Δ": r"$\Delta$", "±": r"$\pm$", "–": "--", "×": r"$\times$"}
SPECIAL |= {"†": r"\dag{}", "τ": r"$\tau$", "δ": r"$\delta$", "√": r"$\surd$"}
LATEX_COMMANDS = {None: "{}", BEST: r"\textbf{{{}}}"}
MARKDOWN_MARKS = {None: "{}", BEST: "**{}**"}
MARKDOWN_SPECIAL = re.compile(r"[\\`*_\[\]|~$#<]|&(?=[#\w])|:(?=//)|(?<=www)\.")
ENTITIES = {"<": "&lt;", "&": "&amp;"}
COLUMNS_OF_A_PAGE = 12  # upright


@dataclass(frozen=True)
class Page:
    """A text that is written as it is."""

    name: str  # of the file
    text: str


def files(made: Table | Page | Chart | Sequence[Table | Chart] | str, svg: bool = False) -> Iterator[tuple[str, bytes]]:
    """Yield safe name and content of each file of a report, none of an empty table; `svg`: charts as SVG, too."""
    if isinstance(made, str):
        yield "report.html", made.encode()
    elif isinstance(made, Page):
        yield made.name, made.text.encode()
    elif isinstance(made, Table):
        for extension, write in (("md", markdown), ("tex", latex), ("csv", csv_text)) if made.blocks else ():
            yield f"{made.name}.{extension}", write(made).encode()
    elif isinstance(made, Chart):
        name = file_name(made.name)
        yield f"{name}.png", made.png
        if svg and not isinstance(made.figure, Image.Image):
            yield f"{name}.svg", made.svg.encode()
        if made.numbers is not None:
            yield f"{name}.csv", made.numbers.to_csv(index=False, lineterminator="\n").encode()
    else:
        names: set[str] = set()
        for part in made:
            if isinstance(part, Chart) and (name := file_name(part.name)) in names:  # of scenes such as a/b and a-b
                part = replace(part, name=f"{name}-{hashlib.sha256(part.title.encode()).hexdigest()[:9]}")
            names.add(file_name(part.name))
            yield from files(part, svg)


def rendered(template: str, **values: Any) -> str:
    """Return the text of a template in this folder; HTML is escaped, and the filter `md` escapes Markdown."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape

    loader, escape = FileSystemLoader(Path(__file__).resolve().parent), select_autoescape(["html.j2"])
    lines: dict[str, Any] = {"trim_blocks": True, "lstrip_blocks": True, "keep_trailing_newline": True}
    environment = Environment(loader=loader, autoescape=escape, undefined=StrictUndefined, **lines)
    environment.filters["md"] = markdown_text
    return environment.get_template(template).render(**values)


def rows_of(table: Table) -> Iterator[tuple[str, list[tuple[str, str | None]]]]:
    """Yield title, and (text, rank) of each cell, of the rows of a table with one block."""
    (block,) = table.blocks
    ranks = marks(block, table.columns)
    for number, row in enumerate(block.rows):
        title, *texts = row.texts(table.columns)
        yield title, [(text, rank.get(number)) for text, rank in zip(texts, ranks, strict=True)]


def markdown(table: Table) -> str:
    """Return GitHub Markdown, a table a block, with the best number of each column bold and the second underlined."""
    parts = [f"## {markdown_text(table.title)}"]
    for block in table.blocks:
        single = table.single(block)
        lines = [[table.corner, *(markdown_text(column.heading) for column in single.columns)]]
        lines.append(["---", *["---:"] * len(single.columns)])
        for title, cells in rows_of(single):
            marked = (MARKDOWN_MARKS.get(rank, "<ins>{}</ins>").format(markdown_text(text)) for text, rank in cells)
            lines.append([markdown_text(title), *marked])
        parts.append("\n".join([f"### {markdown_text(block.title)}\n", *(f"| {' | '.join(line)} |" for line in lines)]))
    if table.notes:
        parts.append("\n".join(f"- {markdown_text(note)}" for note in table.notes))
    return "\n\n".join(parts) + "\n"


def latex(table: Table) -> str:
    """Return LaTeX with booktabs, a `table` a block, shrunk to the page, with the notes below the last one."""
    lines = ["% needs \\usepackage{adjustbox, booktabs, pdflscape}"]
    for number, block in enumerate(table.blocks):
        single = table.single(block)
        wide = len(single.columns) > COLUMNS_OF_A_PAGE
        label = f"tab:{table.name}" + (f"-{number + 1}" if number else "")
        caption = f"  \\caption{{{latex_text(table.title)}: {latex_text(block.title)}}}\\label{{{label}}}"
        lines += [*([r"\begin{landscape}"] if wide else []), r"\begin{table}", r"  \centering", caption]
        lines.append(r"  \begin{adjustbox}{max totalsize={\linewidth}{0.9\textheight}}")
        lines += [f"  \\begin{{tabular}}{{l{'r' * len(single.columns)}}}", r"    \toprule"]
        lines += [*_headings(single), r"    \midrule"]
        for title, cells in rows_of(single):
            shown = (LATEX_COMMANDS.get(rank, r"\underline{{{}}}").format(_number(text)) for text, rank in cells)
            lines.append(_line([latex_text(title), *shown]))
        lines += [r"    \bottomrule", r"  \end{tabular}", r"  \end{adjustbox}", r"\end{table}"]
        lines += [r"\end{landscape}"] if wide else [r"\clearpage"]
    notes = (f"\\noindent {latex_text(note)}\\par" for note in table.notes)
    return "\n".join([*lines, r"\begingroup\footnotesize", *notes, r"\endgroup"]) + "\n"


def csv_text(table: Table) -> str:
    """Return CSV with a line for each cell and all digits; without a number `value` is empty and `status` says why."""
    rows = []
    for block in table.blocks:
        columns = block.own_columns or table.columns
        ranks = marks(block, columns)
        for number, row in enumerate(block.rows):
            for cell, column, rank in zip(row.cells, columns, ranks, strict=True):
                place = {"table": table.name, "block": block.title, "row": row.title}
                place |= {"group": column.group, "column": column.title}
                rows.append({**place, **cell.numbers, "rank": rank.get(number, "")})
    return DataFrame(rows, dtype=object).to_csv(index=False, lineterminator="\n")


def latex_text(words: str) -> str:
    """Return text that LaTeX prints as it is.

    >>> latex_text("50 % of a_b ↑")
    '50 \\\\% of a\\\\_b $\\\\uparrow$'
    """
    return "".join(SPECIAL.get(character, character) for character in words)


def _headings(table: Table) -> list[str]:
    lines, first = [], 2
    groups = [(group, len(list(columns))) for group, columns in groupby(table.columns, lambda column: column.group)]
    if any(group for group, _ in groups):
        cells, rules = [""], ""
        for group, size in groups:
            cells.append(f"\\multicolumn{{{size}}}{{c}}{{{latex_text(group)}}}")
            rules += f"\\cmidrule(lr){{{first}-{first + size - 1}}}" if group else ""
            first += size
        lines += [_line(cells), f"    {rules}"]
    return [*lines, _line([latex_text(table.corner), *(latex_text(column.heading) for column in table.columns)])]


def _number(shown: str) -> str:
    mean, plus_minus, spread = shown.partition(" ± ")
    text = f"${mean[0]}${mean[1:]}" if mean[:1] in ("+", "-") else latex_text(mean)
    return f"{text}{{\\tiny\\,$\\pm$\\,{latex_text(spread)}}}" if plus_minus else text


def _line(cells: list[str]) -> str:
    guard = "{}" if cells[0][:1] in ("[", "*") else ""  # otherwise the end of the line above takes it as an argument
    return f"    {guard}{' & '.join(cells)} \\\\"


def markdown_text(words: str) -> str:
    r"""Return text that GitHub Markdown prints as it is, in a table as well.

    >>> markdown_text("![a](https://b) <c> | `d_1`")
    '!\\[a\\](https\\://b) &lt;c> \\| \\`d\\_1\\`'
    """
    return MARKDOWN_SPECIAL.sub(lambda found: ENTITIES.get(found[0], f"\\{found[0]}"), words)
