"""Methods in the order of their quality, scene by scene, with the ties that the seeds leave."""

from __future__ import annotations

from pandas import DataFrame

from padgs.reports import REPORTS
from padgs.reports.conditions import OF_TIMES, footnotes, refuse_mixture
from padgs.reports.frame import by_conditions
from padgs.reports.gathered import Gathered
from padgs.reports.measures import costs, mark
from padgs.reports.settings import one_setting, settings
from padgs.reports.tables.cells import over_seeds
from padgs.reports.tables.ranking import NOTE, places
from padgs.reports.tables.table import Block, Cell, Column, Row, Table

QUALITY = mark("sphere", "ws_psnr")
MEASURES = (
    QUALITY,
    mark("paper", "psnr"),
    mark("paper", "lpips_vgg_01"),
    *costs("start", "gaussians", "cpu_seconds", "frame_ms"),
)


def order(gathered: Gathered) -> Table:
    """All settings of each experiment that puts methods in an order, the best WS-PSNR first; a block for each scene,
    resolution and length.

    Raises:
        ReportError: results that must not stand together.
    """
    blocks, runs_of = [], {}
    for experiment in REPORTS["order"].experiments:
        for title, own in by_conditions(gathered.of_experiments(experiment), "resolution", "length").items():
            where = f"{experiment}: {title}"
            refuse_mixture(own, gathered.request, where, OF_TIMES)
            blocks.append(Block(where, _rows(own, where)))
            runs_of[where] = own
    notes = [note for protocol in ("paper", "sphere") for note in footnotes(runs_of, protocol)]
    notes += ["Rank: 1 + the number of rows in better places by WS-PSNR, where rows that tie share one.", NOTE]
    columns = (Column("rank", 0), *(measure.column for measure in MEASURES))
    return Table("order", "Methods in the order of their quality", "Method", columns, tuple(blocks), tuple(notes))


def _rows(runs: DataFrame, where: str) -> tuple[Row, ...]:
    """The best first; those without a number last."""
    found = [
        (made.title, over_seeds(one_setting(made.runs, f"{where}, {made.title}"), MEASURES)) for made in settings(runs)
    ]
    found.sort(key=lambda row: (row[1][0].value is None, -(row[1][0].value or 0.0)))
    shared = places({i: row[0] for i, (_, row) in enumerate(found) if row[0].value is not None}, QUALITY.column)
    ranks = {i: Cell(1 + sum(map(len, shared[:place]))) for place, rows in enumerate(shared) for i in rows}
    return tuple(Row(title, (ranks.get(i, Cell()), *cells)) for i, (title, cells) in enumerate(found))
