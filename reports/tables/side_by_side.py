"""Every method beside every other with all that is measured: after as many iterations, or after as much time."""

from __future__ import annotations

import pandas as pd
from pandas import DataFrame

from padgs.reports import methods as names
from padgs.reports.conditions import OF_TIMES, footnotes, refuse_mixture
from padgs.reports.frame import by_conditions, by_place
from padgs.reports.gathered import Gathered
from padgs.reports.measures import Measure, costs, gpu_memory, known_costs, mark
from padgs.reports.tables.cells import of_each
from padgs.reports.tables.ranking import NOTE
from padgs.reports.tables.table import Block, Row, Table
from padgs.reports.unranked import notes as notes_on
from padgs.reports.unranked import unranked

MARKS = {
    "paper": ("psnr", "ssim", "lpips_vgg_01"),
    "sphere": ("ws_psnr", "ws_psnr_equator", "ws_psnr_middle", "ws_psnr_high", "ws_psnr_pole", "seam"),
}


def methods(gathered: Gathered) -> Table:
    """Every method after the same number of iterations."""
    runs = gathered.chosen("methods")
    found = {
        place.title: own for place, own in by_place(runs.loc[runs["variant"] == ""]).items()
    }  # rows of an ablation are not methods
    return _table(gathered, "methods", "Every method after the same number of iterations", found)


def equal_time(gathered: Gathered) -> Table:
    """Every method after the same training time, a block for each scene, resolution and time."""
    found = by_conditions(gathered.of_methods("equal_time"), "resolution", "length")
    return _table(gathered, "equal_time", "Every method after the same training time", found, equal_images=False)


def _costs(runs: DataFrame) -> tuple[Measure, ...]:
    return (
        *costs("iterations_done", "images", "train_seconds"),
        *known_costs(runs, "cpu_seconds"),
        *costs("frame_ms", "start", "gaussians"),
        *costs("megabytes", title="MB"),
        *costs("peak_gigabytes"),
        *gpu_memory(runs),
    )


def _table(
    gathered: Gathered, name: str, title: str, found: dict[str, DataFrame], *, equal_images: bool = True
) -> Table:
    qualities = (mark(protocol, metric, protocol) for protocol, of in MARKS.items() for metric in of)
    measures = (*qualities, *_costs(pd.concat(found.values()) if found else DataFrame()))
    blocks, aside = [], []
    for where, own in found.items():
        refuse_mixture(own, gathered.request, where, OF_TIMES)
        aside.append(unranked(own, equal_images=equal_images))
        titles = {preset: names.title(preset) for preset in names.ordered(own["preset"])}
        cells = of_each(own, "preset", titles, where, measures, aside[-1])
        blocks.append(Block(where, tuple(Row(titles[preset], tuple(row)) for preset, row in cells.items())))
    notes = [note for protocol in MARKS for note in footnotes(found, protocol)]
    notes += [*notes_on(aside), NOTE]
    return Table(name, title, "Method", tuple(m.column for m in measures), tuple(blocks), tuple(notes))
