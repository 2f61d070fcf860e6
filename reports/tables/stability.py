"""Which method survives what: retention under each condition and level, where it breaks, and scores of all."""

from __future__ import annotations

from collections.abc import Sequence

from padgs.reports import methods
from padgs.reports.charts import robustness_chart
from padgs.reports.charts.drawing import Chart
from padgs.reports.conditions import footnotes
from padgs.reports.gathered import Gathered
from padgs.reports.survival import HALF, NOT_SCORED, QUALITY, Survivor, in_order, survivors
from padgs.reports.tables.cells import spread
from padgs.reports.tables.table import Block, Cell, Column, Row, Table

EQUATOR, POLE = "stability/ws_psnr_equator", "stability/ws_psnr_pole"
UNSTRESSED = {  # title -> column of the frame, and those that are subtracted from it
    "WS-PSNR, dB": (QUALITY,),
    "training views above test views, dB": ("stability/ws_psnr_training", QUALITY),
    "equator above poles, dB": (EQUATOR, POLE),
    "the same, above a truth blurred alike, dB": (EQUATOR, POLE, "stability/pole_gap_oracle"),
    "seam": ("stability/seam",),
    "yaw error": ("stability/yaw_error",),
    "depth error (AbsRel)": ("stability/depth_error",),
    "floaters": ("stability/floaters",),
}
NOTES = (
    "Retention: how far above one colour for the image a run stays under a condition, as a share of what the same "
    "method and seed have without it, within [0, 1]; 0 for a run that failed. Level 1 is mild, 3 is severe.",
    f"A method breaks at the first level where it keeps less than {HALF:g} or a run fails; – where it does not.",
    "Score: the mean over conditions of the mean over their levels. Worst quartile: that of the worst quarter of the "
    "conditions; columns stand in its order on the first scene, the best first. Both, and the failure rate, are of "
    f"all conditions but {', '.join(sorted(NOT_SCORED))}, and missing for a method that was not put under all of them "
    "that others were put under on the scene.",
)
CHARTS = (robustness_chart.heat_map, robustness_chart.speed_and_accuracy)


def stability(gathered: Gathered) -> list[Table | Chart]:
    """A table with three blocks for each scene, and of each a heat map and a chart of speed, accuracy and stability.

    Raises:
        ReportError: results that must not stand together.
    """
    found = survivors(gathered)
    presets = list(dict.fromkeys(one.preset for those in found.values() for one in those))
    blocks, runs_of = [], {}
    for title, those in found.items():
        by_preset = {one.preset: one for one in those}
        columns = [by_preset.get(preset) for preset in presets]
        blocks += [Block(title, _scores(columns)), Block(f"Retention, {title}", _retentions(columns))]
        blocks.append(Block(f"Breaks at level, {title}", _breakdowns(columns)))
        runs_of[f"{title}, without stress"] = gathered.runs.loc[sorted(i for one in those for i in one.rest.index)]
    table = Table(
        "stability",
        "What methods keep under stress",
        "Condition",
        tuple(Column(methods.title(preset), 2) for preset in presets),
        tuple(blocks),
        (*footnotes(runs_of, "stability"), *NOTES),
    )
    return [table, *(draw(*one) for one in found.items() for draw in CHARTS)]


def _scores(columns: Sequence[Survivor | None]) -> tuple[Row, ...]:
    rows = [
        Row("stability score", tuple(Cell(one and one.score) for one in columns)),
        Row("worst quartile", tuple(Cell(one and one.worst_quartile) for one in columns)),
        Row("failure rate", tuple(Cell(one and one.failure_rate) for one in columns)),
    ]
    unstressed = {title: tuple(_unstressed(one, *names) for one in columns) for title, names in UNSTRESSED.items()}
    known = {title: cells for title, cells in unstressed.items() if any(cell.value is not None for cell in cells)}
    return (*rows, *(Row(f"unstressed: {title}", cells) for title, cells in known.items()))


def _unstressed(one: Survivor | None, name: str, *others: str) -> Cell:
    if one is None or not {name, *others} <= {*one.rest}:
        return Cell()
    return spread((one.rest[name] - one.rest[[*others]].sum(axis=1, skipna=False)).dropna().tolist())


def _retentions(columns: Sequence[Survivor | None]) -> tuple[Row, ...]:
    stresses = in_order([one for one in columns if one])
    return tuple(
        Row(
            f"{condition} {level}",
            tuple(one.retention.get((condition, level), Cell()) if one else Cell() for one in columns),
        )
        for condition, level in stresses
    )


def _breakdowns(columns: Sequence[Survivor | None]) -> tuple[Row, ...]:
    conditions = dict.fromkeys(condition for one in columns if one for condition in one.conditions)
    return tuple(Row(name, tuple(_breakdown(one, name) for one in columns)) for name in conditions)


def _breakdown(one: Survivor | None, condition: str) -> Cell:
    level = one and one.breakdown(condition)
    return Cell() if level is None else Cell(status=str(level))
