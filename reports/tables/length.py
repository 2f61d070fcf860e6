"""From which number of iterations on methods stand in the order that a long training gives them, and whether rates that
suit the run bring it about sooner.
"""

from __future__ import annotations

from collections.abc import Mapping

import pandas as pd
from pandas import DataFrame

from padgs.reports import methods
from padgs.reports.conditions import footnotes, refuse_mixture
from padgs.reports.frame import by_conditions, grouped
from padgs.reports.gathered import Gathered
from padgs.reports.measures import mark
from padgs.reports.settings import one_setting
from padgs.reports.tables.cells import over_seeds
from padgs.reports.tables.ranking import NOTE, better_rows
from padgs.reports.tables.table import Block, Cell, Column, Row, Table

RATES = "config.train.learning_rates"  # absent in runs from before there was a choice
TITLES = {"published": "published rates", "run": "rates for the run"}  # value of RATES -> title
QUALITY = mark("sphere", "ws_psnr")

Run = tuple[str, int]  # rates, iterations
Cells = Mapping[Run, Mapping[str, Cell]]  # -> method -> its quality


def length(gathered: Gathered) -> Table:
    """WS-PSNR of each method after each length, with the published learning rates and with those for the run; under it
    Kendall's rank correlation (tau-b) of the order of the methods with that after the longest.

    Raises:
        ReportError: results that must not stand together.
    """
    runs = gathered.of_experiments("length")
    runs = runs.assign(**{RATES: "published" if RATES not in runs else runs[RATES].fillna("published")})
    runs = runs.loc[runs[RATES].isin(TITLES)]  # runs at a factor of their own are those of `learning_rates`
    keys = sorted({*zip(runs[RATES], runs["iterations"], strict=True)})  # "published" stands before "run"
    blocks, runs_of, notes = [], {}, []
    for title, own in by_conditions(runs, "resolution").items():
        refuse_mixture(own, gathered.request, title, ("protocol", "data"))
        cells = _cells(own, title)
        names = dict.fromkeys(name for of in cells.values() for name in of)
        rows = (Row(name, tuple(cells.get(key, {}).get(name, Cell()) for key in keys)) for name in names)
        blocks.append(Block(title, tuple(rows)))
        correlations = tuple(_correlation(cells.get(key, {}), _longest(cells, key[0])) for key in keys)
        row = Row("Kendall's rank correlation", correlations)
        blocks.append(Block(f"Order beside that after the longest training, {title}", (row,), signed=True))
        notes += [f"{title}, {_earliest(cells, rates)}" for rates in TITLES if any(of == rates for of, _ in cells)]
        runs_of[title] = own
    columns = tuple(Column(f"{n} iterations, {TITLES[rates]}", 2, True) for rates, n in keys)
    notes += ["The longest: of the same rates, or where these lack it, of the others.", NOTE]
    notes = (*footnotes(runs_of, "sphere"), *notes)
    return Table("length", "WS-PSNR after training of different length", "Method", columns, tuple(blocks), notes)


def _cells(runs: DataFrame, where: str) -> dict[Run, dict[str, Cell]]:
    found: dict[Run, dict[str, Cell]] = {}
    for preset in methods.ordered(runs["preset"]):
        own = runs.loc[runs["preset"] == preset]
        for (variant, rates, iterations), alike in grouped(own, "variant", RATES, "iterations"):
            name = ", ".join(filter(None, (methods.title(preset), variant)))
            one = one_setting(alike, f"{where}, {name}, {iterations} iterations, {TITLES[rates]}")
            (found.setdefault((rates, iterations), {})[name],) = over_seeds(one, [QUALITY])
    return found


def _longest(cells: Cells, rates: str) -> Mapping[str, Cell]:
    """The qualities after the longest training: at the published 30 000 iterations both choices of rates are one."""
    iterations = max(n for _, n in cells)
    return cells.get((rates, iterations)) or next(of for (_, n), of in cells.items() if n == iterations)


def _correlation(cells: Mapping[str, Cell], longest: Mapping[str, Cell]) -> Cell:
    both = pd.DataFrame({"here": _values(cells), "there": _values(longest)}).dropna()
    return Cell(float(both["here"].corr(both["there"], method="kendall"))) if len(both) > 1 else Cell()


def _values(cells: Mapping[str, Cell]) -> pd.Series:
    return pd.Series({name: cell.value for name, cell in cells.items()}, dtype=float)


def _earliest(cells: Cells, rates: str) -> str:
    """From which length on every pair that seeds separate after the longest has its order there."""
    longest, since = _longest(cells, rates), None
    numbered = {name: cell for name, cell in longest.items() if cell.value is not None}
    names, repeated = list(numbered), any(cell.count > 1 for cell in numbered.values())
    better = better_rows(dict(enumerate(numbered.values())), QUALITY.column)
    pairs = [(names[i], names[j]) for i, those in better.items() for j in those]  # worse, better
    for iterations in sorted((n for of, n in cells if of == rates), reverse=True):
        here = _values(cells[rates, iterations])
        if not all(here[first] < here[second] for first, second in pairs if {first, second} <= {*here.dropna().index}):
            break
        since = iterations
    if not pairs:
        return f"{TITLES[rates]}: seeds separate nothing after the longest."
    if since is None:
        return f"{TITLES[rates]}: no length has the order of the longest."
    what = "all that seeds separate after the longest has its order" if repeated else "the order is that of the longest"
    return f"{TITLES[rates]}: from {since} iterations on, {what}{'' if repeated else ' (one seed each)'}."
