"""Builder of the tables in `tables.yaml`."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from pandas import DataFrame, Series

from padgs.reports import REPORTS, frame, methods, published
from padgs.reports.conditions import as_published, footnotes, refuse_mixture, unranked, unranked_notes
from padgs.reports.frame import by_conditions, by_place, grouped, law, without_data
from padgs.reports.measures import Measure, quantity
from padgs.reports.published import AVERAGE, Place
from padgs.reports.selection import Mixture, RunSet, experiment_of, one_setting, refuse_differences, settings
from padgs.reports.significance import is_few, mean_cell, numbers_of, over_scenes, over_seeds, places, unrank
from padgs.reports.specs import PREPARE, SPECS, TITLES
from padgs.reports.table import Block, Cell, Column, Row, Table

PAPER_COLUMNS = ("paper", "Δ")  # titles of the columns that published numbers add
# No column if no run has a number
IF_KNOWN = ("cpu_seconds", "peak_gpu_gigabytes", "sphere/abs_rel", "sphere/delta_1_25")
SEEN_NOTE = (
    "Tuned on: settings of methods were chosen on the scene; not tuned on: none was, but for the exceptions that the "
    "limitations name."
)
RANKS = "Rank: 1 + the number of rows in better places by {}, where all rows have 3 seeds; rows that tie share one."
RATES = {"published": "published rates", "run": "rates for the run"}


def table(run_set: RunSet, name: str) -> Table:
    """Return the table of a name in `SPECS`."""
    return (_Pivot if SPECS[name].pivot else _Builder)(run_set, name).build()


class _Builder:
    """Blocks of rows, with a column for each measure."""

    def __init__(self, run_set: RunSet, name: str) -> None:
        self.name, self.spec, self.request = name, SPECS[name], run_set.request
        self.runs = self._select(run_set)
        self.protocols = self.spec.protocols or (self.request.protocol,)
        is_beside = self.spec.paper and self.request.protocol == published.PROTOCOL
        self.paper = published.load() if is_beside and any(place.published for place in self.runs["place"]) else {}
        known = self.runs.columns[self.runs.notna().any()]
        measures = self.spec.measures(self.request.protocol)
        if self.request.metrics and not self.spec.pivot:
            own = {measure.name.rpartition("/")[2]: measure for measure in measures}
            own |= {of.name.rpartition("/")[2]: of for of in measures if of.name.startswith(self.request.protocol)}
            measures = [own.get(n) or quantity(n, self.request.protocol, run_set.runs) for n in self.request.metrics]
        self.measures = [measure for measure in measures if measure.name in known or measure.name not in IF_KNOWN]
        self.direction = self.measures[0].column.higher_is_better if self.measures else None
        self.shown: dict[str, DataFrame] = {}  # title of a block -> its runs
        self.unranked: list[Mapping[str, tuple[str, str]]] = []  # presets that are not ranked, of each block

    def build(self) -> Table:
        blocks, single, notes = list[Block](), list[Block](), list[str]()
        there = list(by_place(self.runs))
        for title, place, runs in self._groups():
            refuse_mixture(runs, self.request, title, self.spec.shared)
            self.shown[title] = runs
            if not (self.spec.scenes_down and place.published and not place.apart):
                single += self._blocks(title, place, runs)
        for dataset in self.spec.paper if self.spec.averages else ():
            every = published.scenes(published.load(), published.DATASETS[dataset])
            if done := [of for of in there if of.dataset == dataset and not of.apart]:
                done.sort(key=lambda place: every.index(place.scene) if place.scene in every else len(every))
                blocks += self._average(published.TITLES[dataset], done, len(every), self.runs)
                if missing := [scene for scene in every if scene not in {place.scene for place in done}]:
                    apart = {place.scene for place in there if place.apart}
                    for words, of in (("not run", set(missing) - apart), ("in no mean, as its runs differ", apart)):
                        if named := [scene for scene in missing if scene in of]:
                            notes.append(f"{published.TITLES[dataset]}, {words}: {', '.join(named)}.")
                if self.spec.scenes_down:
                    blocks += self._scenes_down(dataset, done)
        for values, runs in grouped(self.runs, *self.spec.blocks) if self.spec.averages else ():
            others = [place for place in by_place(runs) if not place.apart and place.dataset not in self.spec.paper]
            for kind in dict.fromkeys(place.seen for place in others):
                own = [place for place in others if place.seen == kind]
                try:
                    blocks += self._average("", own, len(own), runs, values)
                except Mixture as mixture:  # each scene has a block of its own all the same
                    notes.append(f"No mean over the scenes{f' {kind}' if kind else ''}: {mixture.what}.")
        notes += footnotes(self.shown, *self.protocols)
        if self.paper:
            delta = any(measure.difference for measure in self.measures)
            words = "; Δ = ours - paper, at the size and length of the paper only" if delta else ""
            notes.append(f"'paper': published numbers, from one RTX 3090 Ti{words}.")
        if any(place.seen for place in there):
            notes.append(SEEN_NOTE)
        notes += [*unranked_notes(self.unranked), *filter(None, [self.spec.difference])]
        if self.spec.by_rank and self.direction is not None:
            notes.append(RANKS.format(self.measures[0].column.title))
        notes += self.spec.notes
        return Table(self.name, self.spec.title, self.spec.corner, self._columns(), (*blocks, *single), tuple(notes))

    def _select(self, run_set: RunSet) -> DataFrame:
        spec = self.spec
        if not REPORTS[self.name].experiments:
            return run_set.requested
        runs = run_set.chosen(self.name) if spec.fallback else run_set.of_experiments(*REPORTS[self.name].experiments)
        if spec.rows == "variant":
            runs = runs.loc[runs["variant"].isin([name for titles in TITLES[spec.titles].values() for name in titles])]
        elif spec.rows != "setting":  # rows of an ablation are not methods
            runs = runs.loc[runs["variant"] == ""]
        if spec.rows != "run":
            runs = runs.loc[~runs["stopped"].astype(bool)]
        if spec.outdoor is not None:
            runs = runs.loc[[place.outdoor is spec.outdoor for place in runs["place"]]]
        return PREPARE[spec.prepare](runs)

    def _groups(self) -> Iterator[tuple[str, Place, DataFrame]]:
        """Yield title, scene and runs of each block."""
        spec = self.spec
        if not spec.blocks:
            for place, runs in by_place(self.runs).items():
                yield place.title, place, runs
            return
        for experiment in REPORTS[self.name].experiments if spec.by_experiment else ("",):
            names = self.runs["experiments"]
            own = self.runs.loc[[not experiment or experiment in map(experiment_of, of) for of in names]]
            for title, runs in by_conditions(own, *spec.blocks).items():
                yield f"{experiment}: {title}" if experiment else title, runs["place"].iloc[0], runs

    def _blocks(self, title: str, place: Place, runs: DataFrame) -> Iterator[Block]:
        spec = self.spec
        if spec.unranked:
            self.unranked.append(unranked(runs))
        if spec.rows in ("run", "setting"):
            yield Block(title, self._ranked(runs, title) if spec.by_rank else tuple(self._each_run(runs)))
            return
        for method, titles in (TITLES[spec.titles] or {"": self._titles(place, runs)}).items():
            if spec.difference and not runs[spec.rows].isin(titles).any():
                continue
            apart_in = spec.rows if spec.rows == "preset" else "place"  # rows of a variant have titles of their own
            cells = {}
            for value, words in titles.items():
                own = one_setting(runs.loc[runs[spec.rows] == value], f"{title}, {words}", apart_in)
                cells[value] = over_seeds(own, self.measures)
            heading = f"{methods.name(method)}, {title}" if spec.difference else title
            where = (self.spec.paper.get(place.dataset, 0), place)
            theirs = {value: published.row(self.paper, *where, self._method(value)) for value in titles}
            yield Block(heading, self._rows(titles, cells, theirs, runs))

    def _method(self, value: str) -> str:
        """Return the method of the published numbers that a row may stand beside."""
        return f"padgs/{value}" if self.spec.rows == "variant" else methods.published_as(value)

    def _columns(self) -> tuple[Column, ...]:
        found = [Column("rank", 0)] if self.spec.by_rank and self.direction is not None else []
        for measure in self.measures:
            ours = measure.column
            found.append(ours)
            if self.paper and measure.published:
                decimals = ours.decimals if measure.difference else min(ours.decimals, 2)
                found.append(Column(PAPER_COLUMNS[0], decimals, ours.higher_is_better, group=ours.group, optional=True))
                if measure.difference:
                    found.append(Column(PAPER_COLUMNS[1], ours.decimals, signed=True, group=ours.group, optional=True))
            if self.spec.difference and measure.column.group == "PSNR":
                found.append(Column("Δ", 2, signed=True))
        return tuple(found)

    def _titles(self, place: Place, runs: DataFrame) -> dict[str, str]:
        """Return preset -> title of those that were run, and of methods with published numbers."""
        where = (self.spec.paper.get(place.dataset), published.DATASETS.get(place.dataset), place.scene)
        known = (key.method for key in self.paper if (key.table, key.dataset, key.scene) == where)
        presets, run = methods.ordered((*known, *runs["preset"])), {*self.runs["preset"]}
        return {preset: methods.title(preset) if preset in run else methods.name(preset) for preset in presets}

    def _rows(
        self, titles: dict[str, str], cells: dict[str, list[Cell]], theirs: dict[str, dict], runs: DataFrame
    ) -> tuple[Row, ...]:
        of, rows = {value: runs.loc[runs[self.spec.rows] == value] for value in cells}, []
        not_ranked = self.unranked[-1] if self.unranked else ()
        for value, ours in cells.items():
            comparable, row = as_published(of[value]), list[Cell]()
            for measure, cell in zip(self.measures, unrank(ours) if value in not_ranked else ours, strict=True):
                row.append(cell)
                if self.paper and measure.published:
                    row.append(theirs[value].get(measure.published, Cell()))
                    if measure.difference:
                        row.append(_difference(cell, row[-1]) if comparable else Cell())
                if self.spec.difference and measure.column.group == "PSNR":
                    row.append(Cell(_by_seed(of[value], next(iter(of.values())), measure).value, count=0))
            rows.append(Row(titles[value], tuple(row)))
        return tuple(rows)

    def _average(
        self, title: str, places: Sequence[Place], count: int, runs: DataFrame, values: Sequence[str] = ()
    ) -> list[Block]:
        """Return a block with the mean over scenes beside the paper's, of runs with these `values`; none for one."""
        if len(places) < 2:
            return []
        runs = runs.loc[runs["place"].isin(places)]
        words = f"{len(places)} of its {count} scenes" if len(places) < count else f"its {count} scenes"
        kind = f" {places[0].seen}" if places[0].seen else ""
        heading = f"{title}, average over {words}" if title else f"Average over {count} scenes{kind}"
        if not title or len(places) < count:
            heading += f": {', '.join(place.label for place in places)}"
        heading = ", ".join([heading, *values])
        refuse_mixture(runs, self.request, title or heading, [of for of in self.spec.shared if of != "data"])
        self.unranked.append(unranked(runs))
        titles, cells, theirs = self._titles(Place(places[0].dataset, AVERAGE), runs), {}, {}
        settings = without_data(runs)
        for preset, words in titles.items():
            alike = settings.loc[settings["preset"] == preset]
            refuse_differences(alike, f"{title or heading}, {words}", "preset")
            cells[preset] = over_scenes(alike, places, self.measures)
            if title and self.paper:
                table = self.spec.paper[places[0].dataset]
                theirs[preset] = published.mean_row(self.paper, table, places, self._method(preset))
        return [Block(heading, self._rows(titles, cells, {**dict.fromkeys(titles, {}), **theirs}, runs))]

    def _scenes_down(self, dataset: str, places: Sequence[Place]) -> Iterator[Block]:
        """Yield a block for each measure in the layout of the paper: scenes down, methods across."""
        own = {place: self.runs.loc[self.runs["place"] == place] for place in places}
        titles = {of: words for place, runs in own.items() for of, words in self._titles(place, runs).items()}
        blocks = {place: next(iter(self._blocks(place.title, place, runs))) for place, runs in own.items()}
        columns = self._columns()
        for measure in self.measures:
            start, rows = columns.index(measure.column), []
            beside = (measure.published is not None) * (1 + measure.difference) if self.paper else 0
            kinds = ["", *(column.title for column in columns[start + 1 :][:beside])]
            for place, block in blocks.items():
                by_title = {row.title: row.cells for row in block.rows}
                for offset, kind in enumerate(kinds):  # ours, the paper's and the difference
                    cells = tuple(by_title[t][start + offset] if t in by_title else Cell() for t in titles.values())
                    if not kind or any(cell != Cell() for cell in cells):
                        rows.append(Row(f"{place.scene}, {kind}" if kind else place.scene, cells, kind == "Δ"))
            across = replace(measure.column, title=published.TITLES[dataset])
            shown = [replace(measure.column, title=title, group="", higher_is_better=None) for title in titles.values()]
            heading = f"{measure.column.heading}, {published.TITLES[dataset]}"
            yield Block(heading, tuple(rows), own_columns=tuple(shown), across=across)

    def _ranked(self, runs: DataFrame, where: str) -> tuple[Row, ...]:
        """Return a row for each setting, the best first, those without a number last."""
        found, not_ranked = [], self.unranked[-1]
        for one in settings(runs):
            row = over_seeds(one_setting(one.runs, f"{where}, {one.title}"), self.measures)
            found.append((one.title, unrank(row) if one.preset in not_ranked else row))
        sign = -1.0 if self.direction else 1.0
        found.sort(key=lambda row: (row[1][0].value is None, sign * (row[1][0].value or 0.0)))
        cells = {i: row[0] for i, (_, row) in enumerate(found) if row[0].value is not None and row[0].ranked}
        separable = not any(map(is_few, cells.values()))
        shared = places(cells, self.measures[0].column) if separable else []
        ranks = {i: Cell(1 + sum(map(len, shared[:place])), count=0) for place, rows in enumerate(shared) for i in rows}
        first = [() if self.direction is None else (ranks.get(i, Cell()),) for i in range(len(found))]
        return tuple(Row(title, (*rank, *row)) for rank, (title, row) in zip(first, found, strict=True))

    def _each_run(self, runs: DataFrame) -> Iterator[Row]:
        for one in settings(runs):
            for number, (seed, run) in enumerate(zip(one.runs["seed"], one.runs["run"], strict=True)):
                title = ", ".join([one.preset, *one.apart, f"seed {seed}", run.rpartition("_")[2]])
                yield Row(title, tuple(over_seeds(one.runs.iloc[[number]], self.measures)))


class _Pivot(_Builder):
    """A column for each length of training; rows are methods (`length`) or factors on the rates (`learning_rates`)."""

    def build(self) -> Table:
        spec, (measure,) = self.spec, self.measures
        keys = sorted({*self.runs[list(spec.pivot)].itertuples(index=False, name=None)})
        headings = [", ".join([f"{key[-1]} iterations", *(RATES[rates] for rates in key[:-1])]) for key in keys]
        columns = tuple(Column(heading, 2, measure.column.higher_is_better) for heading in headings)
        blocks, notes = list[Block](), list[str]()
        for title, _, runs in self._groups():
            refuse_mixture(runs, self.request, title, spec.shared)
            self.shown[title] = runs
            add = self._factors if [*spec.pivot] == ["iterations"] else self._lengths
            blocks += add(title, runs, dict(zip(keys, columns, strict=True)))
        if [*spec.pivot] == ["iterations"]:
            factors = ", ".join(f"× {law(n):.2f} after {n}" for (n,) in keys)
            notes.append(
                f"The law, √({frame.PUBLISHED_ITERATIONS} / iterations) and at most {frame.LARGEST_FACTOR:g}, gives "
                f"{factors} iterations; for {', '.join(map(methods.name, frame.LINEAR))} it is "
                f"{frame.LINEAR_ITERATIONS} / iterations. Its loss is the difference, seed by seed, of the factor "
                "nearest to it (by their ratio) from the one with the best mean."
            )
        notes = [*footnotes(self.shown, *self.protocols), *notes, *spec.notes]
        return Table(self.name, spec.title, spec.corner, columns, tuple(blocks), tuple(notes))

    def _cells(self, runs: DataFrame, where: str, *columns: str) -> dict[Any, dict[Any, tuple[Cell, DataFrame]]]:
        """Return first column -> values of the others -> mean over seeds, and the runs."""
        found: dict[Any, dict[Any, tuple[Cell, DataFrame]]] = {}
        for (row, *key), own in grouped(runs, *columns):
            own = one_setting(own, f"{where}, {', '.join(map(str, (row, *key)))}")
            found.setdefault(row, {})[tuple(key)] = over_seeds(own, self.measures)[0], own
        return found

    def _factors(self, title: str, runs: DataFrame, keys: Mapping[Any, Column]) -> list[Block]:
        """Return a block for each method, and one with the loss by the law."""
        blocks, losses = [], []
        for preset in methods.ordered(runs["preset"]):
            where = f"{methods.title(preset)}, {title}"
            cells = self._cells(runs.loc[runs["preset"] == preset], where, "rate_factor", "iterations")
            rows = (Row(f"× {f:g}", tuple(cells[f].get(key, (Cell(),))[0] for key in keys)) for f in sorted(cells))
            blocks.append(Block(where, tuple(rows)))
            of_lengths = ({factor: of[key] for factor, of in cells.items() if key in of} for key in keys)
            losses.append(Row(methods.title(preset), tuple(map(self._loss, keys, of_lengths)), True))
        columns = tuple(replace(column, higher_is_better=None) for column in keys.values())
        return [*blocks, Block(f"What the law loses, {title}", tuple(losses), columns)]

    def _loss(self, key: tuple[int], factors: Mapping[float, tuple[Cell, DataFrame]]) -> Cell:
        means = {factor: cell.value for factor, (cell, _) in factors.items() if cell.value is not None}
        if not means:
            return Cell()
        near = min(means, key=lambda of: abs(math.log(of / law(key[0], factors[of][1]["method"].iloc[0]))))
        best = max(means, key=lambda factor: means[factor])
        return _by_seed(factors[near][1], factors[best][1], self.measures[0])

    def _lengths(self, title: str, runs: DataFrame, keys: Mapping[Any, Column]) -> list[Block]:
        cells = self._cells(runs, title, "preset", *self.spec.pivot)
        titles = {preset: methods.title(preset) for preset in methods.ordered(cells)}
        rows = (Row(words, tuple(cells[of].get(key, (Cell(),))[0] for key in keys)) for of, words in titles.items())
        return [Block(title, tuple(rows))]


def _by_seed(ours: DataFrame, theirs: DataFrame, measure: Measure) -> Cell:
    """Return the mean difference of the runs of two settings with the same seeds, failed runs left out."""
    first, second = (Series(numbers_of(of, [measure])[:, 0], of["seed"]) for of in (ours, theirs))
    return mean_cell((first - second).dropna().tolist())


def _difference(ours: Cell, theirs: Cell) -> Cell:
    return Cell() if ours.value is None or theirs.value is None else Cell(ours.value - theirs.value, count=0)
