"""Every method beside every other with all that is measured: after as many iterations, or after as much time."""

from __future__ import annotations

from collections.abc import Sequence

from padgs.results import Result
from reports import methods as names
from reports.conditions import CONDITIONS, OF_TIMES, refuse_mixture
from reports.measures import (
    GPU_MEMORY,
    Measure,
    frame_ms,
    gaussians,
    mark,
    megabytes,
    on_gpu,
    peak_gigabytes,
    train_seconds,
)
from reports.metrics import column
from reports.request import Request
from reports.scenes import Place, at, places
from reports.settings import chosen
from reports.tables.cells import one_setting, over_seeds, refuse_differences
from reports.tables.equal_time import EXPERIMENT, TOLERANCE, common_seconds, is_near, nearest_to, of_any_length
from reports.tables.footnotes import conditions
from reports.tables.ranking import NOTE
from reports.tables.table import Block, Column, Row, Table

MARKS = {
    "paper": ("psnr", "ssim", "lpips_vgg_01"),
    "sphere": ("ws_psnr", "ws_psnr_equator", "ws_psnr_middle", "ws_psnr_high", "ws_psnr_pole", "seam"),
}
COSTS = (
    Measure(Column("iterations", 0), lambda result: result.iterations_done),
    Measure(Column("training s", 0, False), train_seconds),
    Measure(Column("ms per frame", 1, False), frame_ms),
    Measure(Column("Gaussians", 0), gaussians),
    Measure(Column("MB", 1, False), megabytes),
    Measure(Column("peak GB", 2, False), peak_gigabytes),
)


def methods(results: Sequence[Result], request: Request) -> Table:
    """Every method after the same number of iterations."""
    runs = [result for result in chosen(results, "methods", request) if not result.variant]
    blocks = {}
    for place in places(runs):
        own = at(place, runs)
        refuse_mixture(own, request, place.title, CONDITIONS)
        blocks[place] = own
    return _table("methods", "Every method after the same number of iterations", blocks)


def equal_time(results: Sequence[Result], request: Request) -> Table:
    """Every method after the same training time: of the runs of each, the one nearest to the time that most took.

    A run of the comparison after equal iterations counts where it happened to take as long.
    """
    runs = [r for r in chosen(results, "equal_time", request) if EXPERIMENT in r.experiments and not r.variant]
    others = [r for r in chosen(results, "methods", request) if r not in runs and not r.variant]
    alike = {what: of for what, of in OF_TIMES.items() if what != "iterations"}
    blocks, notes = {}, []
    for place in places(runs):
        seconds = common_seconds(at(place, runs))
        own = [*at(place, runs), *(result for result in at(place, others) if is_near(result, seconds))]
        refuse_mixture(own, request, place.title, alike)
        for preset in names.ordered(result.preset for result in own):
            own_runs = [of_any_length(r) for r in own if r.preset == preset]
            # Else the nearer of two settings would stand for both.
            refuse_differences(own_runs, f"{place.title}, {names.title(preset)}")
        blocks[place] = [of_any_length(r) for r in nearest_to(seconds, own)]
        off = names.ordered(r.preset for r in blocks[place] if r.ok and not is_near(r, seconds))
        if off:
            notes.append(
                f"{place.title}: not within {TOLERANCE:.0%} of {seconds:.0f} s: {', '.join(map(names.title, off))}."
            )
    return _table("equal_time", "Every method after the same training time", blocks, notes)


def _table(name: str, title: str, runs: dict[Place, list[Result]], notes: Sequence[str] = ()) -> Table:
    measured = [result for own in runs.values() for result in own]
    measures = (*_marks(), *COSTS, *((GPU_MEMORY,) if on_gpu(measured) else ()))
    blocks = []
    for place, own in runs.items():
        rows = []
        for preset in names.ordered(result.preset for result in own):
            setting = one_setting([r for r in own if r.preset == preset], f"{place.title}, {names.title(preset)}")
            rows.append(Row(names.title(preset), tuple(over_seeds(setting, m.number) for m in measures)))
        blocks.append(Block(place.title, tuple(rows)))
    by_title = {place.title: own for place, own in runs.items()}
    notes = [*notes, *(note for protocol in MARKS for note in conditions(by_title, protocol))]
    return Table(name, title, "Method", tuple(m.column for m in measures), tuple(blocks), (*notes, NOTE))


def _marks() -> tuple[Measure, ...]:
    return tuple(
        Measure(column(metric, protocol), mark(protocol, metric)) for protocol, of in MARKS.items() for metric in of
    )
