"""Methods beside each other: a block for each scene that was run, and the averages over the data sets of the paper."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from padgs.results import Result
from reports import methods, published
from reports.conditions import CONDITIONS, OF_A_DATA_SET, Condition, refuse_mixture
from reports.measures import Measure
from reports.published import Key, Published
from reports.request import Request
from reports.scenes import Place, at, places
from reports.settings import chosen
from reports.tables.cells import difference, of_the_paper, one_setting, over_scenes, over_seeds
from reports.tables.footnotes import conditions
from reports.tables.table import Block, Cell, Column, Row, Table

AVERAGE = "average"


@dataclass(frozen=True)
class Comparison:
    """A table of methods: which numbers, of which scenes, beside which published ones."""

    name: str
    title: str
    measures: tuple[Measure, ...]
    tables: Mapping[str, int]  # data set of the paper -> the paper's table about it
    belongs: Callable[[Place], bool]
    alike: Mapping[str, Condition] = field(default_factory=lambda: CONDITIONS)
    notes: tuple[str, ...] = ()

    def build(self, results: Sequence[Result], request: Request) -> Table:
        """The table of all results that the request admits; rows of an ablation (`variant`) are not methods.

        Raises:
            ReportError: results that must not stand together.
        """
        paper = published.load() if request.protocol == published.PROTOCOL else {}
        runs = [result for result in chosen(results, self.name, request) if not result.variant]
        found = [place for place in places(runs) if self.belongs(place)]
        blocks: list[Block] = []
        notes: list[str] = []
        for dataset in dict.fromkeys((*self.tables, *(place.dataset for place in found))):
            for place in (place for place in found if place.dataset == dataset):
                refuse_mixture(at(place, runs), request, place.title, self.alike)
                blocks.append(self._scene(place, at(place, runs), paper))
            if dataset not in self.tables:
                continue
            own = [result for result in runs if result.dataset == dataset]
            refuse_mixture(own, request, published.TITLES[dataset], self._of_a_data_set)
            blocks.append(self._average(dataset, own, paper))
            not_run = [scene for scene in self._scenes(dataset, paper) if Place(dataset, scene) not in found]
            if not_run:
                notes.append(f"{published.TITLES[dataset]}, not run: {', '.join(not_run)}.")
        notes += conditions({place.title: at(place, runs) for place in found}, request.protocol)
        if paper:
            delta = "; Δ = ours - paper" if any(measure.difference for measure in self.measures) else ""
            notes.append(f"Columns 'paper': published numbers, from one RTX 3090 Ti{delta}.")
        columns = tuple(column for measure in self.measures for column in _columns(measure, bool(paper)))
        return Table(self.name, self.title, "Method", columns, tuple(blocks), (*notes, *self.notes))

    @property
    def _of_a_data_set(self) -> dict[str, Condition]:
        return {what: of for what, of in self.alike.items() if what in OF_A_DATA_SET or what not in CONDITIONS}

    def _scenes(self, dataset: str, paper: Mapping[Key, Published]) -> list[str]:
        return published.scenes(paper or published.load(), published.DATASETS[dataset])

    def _scene(self, place: Place, own: Sequence[Result], paper: Mapping[Key, Published]) -> Block:
        known = self._published_methods(place.dataset, place.scene, paper)
        rows = []
        for preset in methods.ordered([*known, *(result.preset for result in own)]):
            runs = [result for result in own if result.preset == preset]
            runs = one_setting(runs, f"{place.title}, {methods.title(preset)}")
            ours = [over_seeds(runs, measure.number) for measure in self.measures]
            rows.append(self._row(preset, ours, place.dataset, place.scene, paper))
        return Block(place.title, tuple(rows))

    def _average(self, dataset: str, own: Sequence[Result], paper: Mapping[Key, Published]) -> Block:
        scenes = self._scenes(dataset, paper)
        known = self._published_methods(dataset, AVERAGE, paper)
        rows = []
        for preset in methods.ordered([*known, *(result.preset for result in own)]):
            runs = [at(Place(dataset, scene), (r for r in own if r.preset == preset)) for scene in scenes]
            ours = [over_scenes(runs, measure.number) for measure in self.measures]
            rows.append(self._row(preset, ours, dataset, AVERAGE, paper))
        return Block(f"{published.TITLES[dataset]}, average over its {len(scenes)} scenes", tuple(rows))

    def _published_methods(self, dataset: str, scene: str, paper: Mapping[Key, Published]) -> set[str]:
        table, theirs = self.tables.get(dataset), published.DATASETS.get(dataset)
        return {key.method for key in paper if (key.table, key.dataset, key.scene) == (table, theirs, scene)}

    def _row(self, preset: str, ours: Sequence[Cell], dataset: str, scene: str, paper: Mapping[Key, Published]) -> Row:
        cells: list[Cell] = []
        for measure, cell in zip(self.measures, ours, strict=True):
            cells.append(cell)
            if paper and measure.published:
                table, theirs_of = self.tables.get(dataset, 0), published.DATASETS.get(dataset, dataset)
                key = Key(table, theirs_of, scene, methods.published_as(preset), measure.published)
                theirs = of_the_paper(paper.get(key))
                cells += [theirs, difference(cell, theirs)] if measure.difference else [theirs]
        return Row(methods.title(preset), tuple(cells))


def _columns(measure: Measure, beside_the_paper: bool) -> list[Column]:
    columns = [measure.column]
    if beside_the_paper and measure.published:
        decimals = min(measure.column.decimals, 2) if not measure.difference else measure.column.decimals
        columns.append(
            Column("paper", decimals, measure.column.higher_is_better, group=measure.column.group, optional=True)
        )
        if measure.difference:
            columns.append(Column("Δ", measure.column.decimals, signed=True, group=measure.column.group, optional=True))
    return columns
