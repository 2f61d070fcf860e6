"""Methods with equal numbers of Gaussians: which makes the most of them."""

from __future__ import annotations

import numbers

from padgs.reports import methods
from padgs.reports.conditions import OF_TIMES, footnotes, refuse_mixture
from padgs.reports.frame import CONFIG, by_conditions
from padgs.reports.gathered import Gathered
from padgs.reports.measures import costs, mark
from padgs.reports.tables.cells import of_each
from padgs.reports.tables.ranking import NOTE
from padgs.reports.tables.table import Block, Row, Table

BUDGET = f"{CONFIG}budget.gaussians"
MEASURES = (
    mark("sphere", "psnr", "sphere"),
    mark("sphere", "ws_psnr", "sphere"),
    mark("sphere", "ws_psnr_pole", "sphere"),
    mark("sphere", "ws_lpips_alex", "sphere"),
    *costs("gaussians", "cpu_seconds", "frame_ms"),
)
AT_MOST = (
    "At most: when training ends. padgs+ grows to twice as many and keeps those that are missed most; the others never "
    "have more."
)


def capacity(gathered: Gathered) -> Table:
    """A block for each number of Gaussians that was asked for, on each scene, at each resolution and length.

    Raises:
        ReportError: results that must not stand together.
    """
    runs, blocks, runs_of = gathered.of_methods("capacity"), [], {}
    if len(runs):
        runs = runs.loc[
            runs[BUDGET].map(lambda asked: isinstance(asked, numbers.Real) and asked > 0)
        ]  # not auto or null
        runs = runs.sort_values(BUDGET, kind="stable")
        runs = runs.assign(asked=[f"at most {count:,} Gaussians".replace(",", " ") for count in runs[BUDGET]])
    for title, own in by_conditions(runs, "resolution", "length", "asked").items() if len(runs) else ():
        refuse_mixture(own, gathered.request, title, OF_TIMES)
        titles = {preset: methods.title(preset) for preset in methods.ordered(own["preset"])}
        cells = of_each(own, "preset", titles, title, MEASURES)
        blocks.append(Block(title, tuple(Row(titles[preset], tuple(row)) for preset, row in cells.items())))
        runs_of[title] = own
    columns = tuple(measure.column for measure in MEASURES)
    notes = (*footnotes(runs_of, "sphere"), AT_MOST, NOTE)
    return Table("capacity", "Methods with equal numbers of Gaussians", "Method", columns, tuple(blocks), notes)
