"""Every method beside every other with all that is measured: after as many iterations, or after as much time."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd
from pandas import DataFrame

from reports import methods as names
from reports.conditions import OF_EQUAL_TIMES, footnotes, refuse_mixture
from reports.frame import by_place
from reports.gathered import Gathered
from reports.measures import Measure, costs, gpu_memory, known_costs, mark
from reports.scenes import Place
from reports.settings import refuse_differences
from reports.tables.cells import of_each
from reports.tables.equal_time import EXPERIMENT, TOLERANCE, common_seconds, is_near, nearest_to, of_any_length
from reports.tables.ranking import NOTE
from reports.tables.table import Block, Row, Table
from reports.unranked import notes as notes_on
from reports.unranked import unranked

MARKS = {
    "paper": ("psnr", "ssim", "lpips_vgg_01"),
    "sphere": ("ws_psnr", "ws_psnr_equator", "ws_psnr_middle", "ws_psnr_high", "ws_psnr_pole", "seam"),
}


def methods(gathered: Gathered) -> Table:
    """Every method after the same number of iterations."""
    runs = _methods(gathered, "methods")
    for place, own in by_place(runs).items():
        refuse_mixture(own, gathered.request, place.title)
    return _table("methods", "Every method after the same number of iterations", by_place(runs))


def equal_time(gathered: Gathered) -> Table:
    """Every method after the same training time: of the runs of each, the one nearest to the time that most took.

    A run of the comparison after equal iterations counts where it happened to take as long.
    """
    runs = _methods(gathered, "equal_time")
    runs = runs.loc[[EXPERIMENT in of for of in runs["experiments"]]]
    others = _methods(gathered, "methods").drop(runs.index, errors="ignore")
    found, notes = {}, []
    for place, own in by_place(runs).items():
        seconds = common_seconds(own)
        near = others.loc[(others["place"] == place) & is_near(others["train_seconds"], seconds)]
        own = of_any_length(gathered.runs.loc[[*own.index, *near.index]])
        refuse_mixture(own, gathered.request, place.title, OF_EQUAL_TIMES)
        for preset in names.ordered(own["preset"]):  # else the nearer of two settings would stand for both
            refuse_differences(own.loc[own["preset"] == preset], f"{place.title}, {names.title(preset)}")
        found[place] = nearest_to(seconds, own)
        off = found[place].loc[found[place]["ok"] & ~is_near(found[place]["train_seconds"], seconds)]
        if len(off):
            titles = "; ".join(map(names.title, names.ordered(off["preset"])))
            notes.append(f"{place.title}: not within {TOLERANCE:.0%} of {seconds:.0f} s: {titles}.")
    return _table("equal_time", "Every method after the same training time", found, notes, equal_images=False)


def _methods(gathered: Gathered, report: str) -> DataFrame:
    """The runs for a report; rows of an ablation (`variant`) are not methods."""
    runs = gathered.chosen(report)
    return runs.loc[runs["variant"] == ""]


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
    name: str, title: str, found: dict[Place, DataFrame], notes: Sequence[str] = (), *, equal_images: bool = True
) -> Table:
    qualities = (mark(protocol, metric, protocol) for protocol, of in MARKS.items() for metric in of)
    measures = (*qualities, *_costs(pd.concat(found.values()) if found else DataFrame()))
    aside = {place: unranked(own, equal_images=equal_images) for place, own in found.items()}
    blocks = []
    for place, own in found.items():
        titles = {preset: names.title(preset) for preset in names.ordered(own["preset"])}
        cells = of_each(own, "preset", titles, place.title, measures, aside[place])
        blocks.append(Block(place.title, tuple(Row(titles[preset], tuple(row)) for preset, row in cells.items())))
    by_title = {place.title: own for place, own in found.items()}
    notes = [*notes, *(note for protocol in MARKS for note in footnotes(by_title, protocol))]
    notes += [*notes_on(aside.values()), NOTE]
    return Table(name, title, "Method", tuple(m.column for m in measures), tuple(blocks), tuple(notes))
