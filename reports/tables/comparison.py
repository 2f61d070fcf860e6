"""Methods beside each other: a block for each scene that was run, and the averages over the data sets of the paper."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

from pandas import DataFrame

from padgs.reports import methods, published
from padgs.reports.conditions import CONDITIONS, footnotes, refuse_mixture
from padgs.reports.frame import by_place
from padgs.reports.gathered import Gathered
from padgs.reports.measures import Measure, alone
from padgs.reports.published import Key, Published
from padgs.reports.scenes import Place
from padgs.reports.settings import refuse_differences
from padgs.reports.tables import beside_paper
from padgs.reports.tables.cells import of_each, only_shown, over_scenes
from padgs.reports.tables.table import Block, Cell, Row, Table
from padgs.reports.unranked import Reason, unranked
from padgs.reports.unranked import notes as notes_on

Measures = Sequence[Measure]
Numbers = Mapping[Key, Published]  # of the paper; none under a protocol that is not its own
AVERAGE = "average"


@dataclass(frozen=True)
class Comparison:
    """A table of methods: which numbers, of which scenes, beside which published ones."""

    name: str
    title: str
    measures: tuple[Measure, ...]
    tables: Mapping[str, int]  # data set of the paper -> the paper's table about it
    belongs: Callable[[Place], bool]
    alike: Sequence[str] = CONDITIONS
    notes: tuple[str, ...] = ()

    def build(self, gathered: Gathered) -> Table:
        """The table of all runs that the request admits; rows of an ablation (`variant`) are not methods.

        Raises:
            ReportError: results that must not stand together.
        """
        request, runs = gathered.request, gathered.chosen(self.name)
        runs = runs.loc[runs["variant"] == ""]
        found = {place: own for place, own in by_place(runs).items() if self.belongs(place)}
        paper = published.load() if request.protocol == published.PROTOCOL else {}
        measures = self.measures if paper else tuple(map(alone, self.measures))
        blocks: list[Block] = []
        notes: list[str] = []
        aside: list[dict[str, Reason]] = []
        for dataset in dict.fromkeys((*self.tables, *(place.dataset for place in found))):
            for place, own in found.items():
                if place.dataset == dataset:
                    refuse_mixture(own, request, place.title, self.alike)
                    aside.append(unranked(own))
                    blocks.append(self._scene(place, own, measures, paper, aside[-1]))
            if dataset not in self.tables:
                continue
            own = runs.loc[[(place.dataset, place.apart) == (dataset, "") for place in runs["place"]]]
            refuse_mixture(own, request, published.TITLES[dataset], [what for what in self.alike if what != "data"])
            scenes = published.scenes(paper or published.load(), published.DATASETS[dataset])
            aside.append(unranked(own))
            blocks.append(self._average(dataset, scenes, own, measures, paper, aside[-1]))
            run = {(place.dataset, place.scene) for place in found}
            not_run = [scene for scene in scenes if (dataset, scene) not in run]
            if not_run:
                notes.append(f"{published.TITLES[dataset]}, not run: {', '.join(not_run)}.")
        notes += footnotes({place.title: own for place, own in found.items()}, request.protocol)
        if paper:
            delta = "; Δ = ours - paper" if any(measure.difference for measure in measures) else ""
            notes.append(f"Columns 'paper': published numbers, from one RTX 3090 Ti{delta}.")
        notes += notes_on(aside)
        columns = beside_paper.columns(measures)
        return Table(self.name, self.title, "Method", columns, tuple(blocks), (*notes, *self.notes))

    def _scene(self, place: Place, own: DataFrame, measures: Measures, paper: Numbers, aside: Collection[str]) -> Block:
        titles = self._titles(place, own, paper)
        cells = of_each(own, "preset", titles, place.title, measures, aside)
        rows = (self._row(titles[preset], preset, place, measures, ours, paper) for preset, ours in cells.items())
        return Block(place.title, tuple(rows))

    def _average(
        self,
        dataset: str,
        scenes: Sequence[str],
        own: DataFrame,
        measures: Measures,
        paper: Numbers,
        aside: Collection[str],
    ) -> Block:
        rows, place = [], Place(dataset, AVERAGE)
        for preset, title in self._titles(place, own, paper).items():
            alike = own.loc[own["preset"] == preset]
            refuse_differences(alike, f"{published.TITLES[dataset]}, {title}", "preset")
            ours = over_scenes(alike, scenes, measures)
            ours = only_shown(ours) if preset in aside else ours
            rows.append(self._row(title, preset, place, measures, ours, paper))
        return Block(f"{published.TITLES[dataset]}, average over its {len(scenes)} scenes", tuple(rows))

    def _titles(self, place: Place, own: DataFrame, paper: Numbers) -> dict[str, str]:
        """Preset -> title of those that were run, and of the methods that the paper has numbers of."""
        where = (self.tables.get(place.dataset), published.DATASETS.get(place.dataset), place.scene)
        known = (key.method for key in paper if (key.table, key.dataset, key.scene) == where)
        run = set(own["preset"])
        presets = methods.ordered((*known, *run))
        return {preset: methods.title(preset) if preset in run else methods.name(preset) for preset in presets}

    def _row(
        self, title: str, preset: str, place: Place, measures: Measures, ours: Sequence[Cell], paper: Numbers
    ) -> Row:
        table, method = self.tables.get(place.dataset, 0), methods.published_as(preset)
        theirs = published.row(paper, table, place.dataset, place.scene, method)
        return Row(title, beside_paper.cells(measures, ours, theirs))
