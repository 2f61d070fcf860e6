"""What methods lose under stress, beside what they may: `padgs.reports.limits`, where these are made for such runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from padgs.reports import methods
from padgs.reports.conditions import footnotes
from padgs.reports.gathered import Gathered
from padgs.reports.limits import LIMITS, MADE_FOR, Limit
from padgs.reports.survival import QUALITY, Stress, Survivor, in_order, survivors
from padgs.reports.tables.cells import spread
from padgs.reports.tables.table import Block, Cell, Column, Row, Table

TOLD = Limit(())  # of a condition without a limit: what is lost of the WS-PSNR
BEYOND = "beyond"
MARKS = {"seam": "seam", "depth_error": "depth error", "ws_psnr_fitted": "dB after a fit of colours", "ws_psnr": "dB"}
NOTES = (
    "dB: WS-PSNR without the condition less that with it, of the same seed; after a fit of colours: each view with the "
    "gain and the offset of each channel that bring it nearest to the truth. Other rows: the mark under the condition.",
    "BEYOND: more than is allowed, which is for runs of a method that is meant to survive; – in the first column: no "
    "limit, only told.",
)


def limits(gathered: Gathered) -> Table:
    """A block for each scene that was run as limits are made for.

    Raises:
        ReportError: results that must not stand together.
    """
    found = {title: of for title, those in survivors(gathered).items() if (of := [one for one in those if _fits(one)])}
    presets = list(dict.fromkeys(one.preset for those in found.values() for one in those))
    blocks = [Block(title, _rows([_of(preset, those) for preset in presets], those)) for title, those in found.items()]
    runs = {
        f"{title}, without stress": gathered.runs.loc[sorted(i for one in those for i in one.rest.index)]
        for title, those in found.items()
    }
    columns = (Column("allowed", 2), *(Column(methods.title(preset), 2) for preset in presets))
    notes = (*footnotes(runs, "stability"), *NOTES)
    return Table("limits", "What methods lose under stress, and may lose", "Condition", columns, tuple(blocks), notes)


def _fits(one: Survivor) -> bool:
    size, iterations = MADE_FOR
    return bool(((one.rest["resolution"] == size) & (one.rest["iterations"] == iterations)).all())


def _of(preset: str, those: Sequence[Survivor]) -> Survivor | None:
    return next((one for one in those if one.preset == preset), None)


def _rows(columns: Sequence[Survivor | None], those: Sequence[Survivor]) -> tuple[Row, ...]:
    rows = []
    for condition, level in in_order(those):
        limit = LIMITS.get(condition, TOLD)
        allowed = limit.levels[level - 1] if level <= len(limit.levels) else None
        cells = [_lost(one, (condition, level), limit, allowed) if one else Cell() for one in columns]
        rows.append(Row(f"{condition} {level}, {MARKS[limit.mark]}", (Cell(allowed), *cells)))
    return tuple(rows)


def _lost(one: Survivor, stress: Stress, limit: Limit, allowed: float | None) -> Cell:
    """The mean over seeds, with how runs failed or that it is more than allowed."""
    runs, mark = one.runs.get(stress), QUALITY.replace("ws_psnr", limit.mark)
    if runs is None:
        return Cell()
    failed = " ".join(runs.loc[~runs["ok"], "status"].unique())
    if mark not in runs or mark not in one.rest:
        return Cell(status=failed)
    ok, rest = runs.loc[runs["ok"]], one.rest.set_index("seed")[mark]
    values = ok[mark].astype(float).to_numpy()
    if limit.lost:
        values = ok["seed"].map(rest).fillna(rest.mean()).astype(float).to_numpy() - values
    cell = spread([value for value in values.tolist() if value == value], failed)
    over = allowed is not None and cell.value is not None and cell.value > allowed
    return replace(cell, status=" ".join(filter(None, (failed, BEYOND if over else ""))))
