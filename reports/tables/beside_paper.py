"""Ours beside the paper's: the columns that measures have, and the cells in them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from padgs.reports.measures import Measure
from padgs.reports.published import Published
from padgs.reports.tables.table import Cell, Column

OF_THE_PAPER = ("paper", "Δ")  # titles of the columns that the paper's numbers bring along


def columns(measures: Iterable[Measure]) -> tuple[Column, ...]:
    """The column of each measure, with those of the paper's number and of the difference where it has them."""
    found: list[Column] = []
    for measure in measures:
        ours = measure.column
        found.append(ours)
        if measure.published:
            decimals = ours.decimals if measure.difference else min(ours.decimals, 2)
            found.append(Column(OF_THE_PAPER[0], decimals, ours.higher_is_better, group=ours.group, optional=True))
        if measure.difference:
            found.append(Column(OF_THE_PAPER[1], ours.decimals, signed=True, group=ours.group, optional=True))
    return tuple(found)


def cells(measures: Sequence[Measure], ours: Sequence[Cell], published: Mapping[str, Published]) -> tuple[Cell, ...]:
    """The cells of a row in these columns; `published`: metric -> the paper's number."""
    found: list[Cell] = []
    for measure, cell in zip(measures, ours, strict=True):
        found.append(cell)
        theirs = _of_the_paper(published.get(measure.published or ""))
        if measure.published:
            found.append(theirs)
        if measure.difference:
            found.append(difference(cell, theirs))
    return tuple(found)


def difference(ours: Cell, theirs: Cell) -> Cell:
    """Ours minus theirs; missing where either is."""
    if ours.value is None or theirs.value is None:
        return Cell()
    return Cell(ours.value - theirs.value)


def _of_the_paper(number: Published | None) -> Cell:
    """A published number; what the paper does not have is missing."""
    if number is None or number.status == "missing":
        return Cell()
    return Cell(number.value, status="" if number.status == "ok" else number.status)
