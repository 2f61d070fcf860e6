"""Voxel size and opacity modulation of PaD-GS, crossed: what each changes, and whether the changes add."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from pandas import DataFrame

from padgs.reports.conditions import OF_TIMES, footnotes, refuse_mixture
from padgs.reports.frame import CONFIG, by_conditions
from padgs.reports.gathered import Gathered
from padgs.reports.measures import costs, mark
from padgs.reports.settings import one_setting
from padgs.reports.tables.cells import over_seeds, spread
from padgs.reports.tables.ranking import NOTE
from padgs.reports.tables.table import Block, Cell, Row, Table

TAU = "method.tau"
VOXELS = {"padgs_small": "one anchor per 3 px", "padgs": "one anchor per 0.1 px"}  # ours for the paper's 0.001
TAUS = (0.0, 0.9)
CELLS = {(preset, tau): f"{title}, τ = {tau:g}" for preset, title in VOXELS.items() for tau in TAUS}
EFFECTS = {  # title -> weight of each of CELLS
    "one anchor per 0.1 px instead of 3 px": (-0.5, -0.5, 0.5, 0.5),
    "τ = 0.9 instead of 0": (-0.5, 0.5, -0.5, 0.5),
    "both, beyond the sum of the two": (1.0, -1.0, -1.0, 1.0),
}
CROPPED = mark("paper", "psnr", "paper")  # the experiment is scored with protocol=roam360
MEASURES = (
    mark("sphere", "psnr", "sphere"),
    mark("sphere", "ws_psnr", "sphere"),
    mark("sphere", "ws_psnr_pole", "sphere"),
    replace(CROPPED, column=replace(CROPPED.column, title="PSNR by the paper's protocol")),
    *costs("polar_transmittance", "start", "gaussians", "cpu_seconds"),
)
PROTOCOLS = ("paper", "sphere")


def modulation(gathered: Gathered) -> Table:
    """A block with the four settings for each scene, resolution and length, and one with the effects.

    An effect is taken seed by seed, as the mean over the levels of the other factor; its spread is that over seeds.

    Raises:
        ReportError: results that must not stand together.
    """
    runs, blocks, runs_of = gathered.of_methods("modulation"), [], {}
    for title, own in by_conditions(runs, "resolution", "length").items():
        refuse_mixture(own, gathered.request, title, OF_TIMES)
        found = {cell: one_setting(_of_cell(own, *cell), f"{title}, {words}") for cell, words in CELLS.items()}
        rows = (Row(words, tuple(over_seeds(found[cell], MEASURES))) for cell, words in CELLS.items())
        blocks.append(Block(title, tuple(rows)))
        effects = (Row(words, _effect(found, weights)) for words, weights in EFFECTS.items())
        blocks.append(Block(f"Effects, {title}", tuple(effects), signed=True))
        runs_of[title] = own
    notes = [note for protocol in PROTOCOLS for note in footnotes(runs_of, protocol)]
    how = "Effects: mean and spread of the differences within each seed, over the levels of the other factor."
    columns = tuple(measure.column for measure in MEASURES)
    title = "Voxel size and opacity modulation of PaD-GS"
    return Table("modulation", title, "Setting", columns, tuple(blocks), (*notes, how, NOTE))


def _of_cell(runs: DataFrame, preset: str, tau: float) -> DataFrame:
    return runs.loc[(runs["preset"] == preset) & (runs[CONFIG + TAU] == tau)]


def _effect(cells: Mapping[tuple[str, float], DataFrame], weights: tuple[float, ...]) -> tuple[Cell, ...]:
    """A cell for each measure, over the seeds that all four settings have."""
    names = [measure.name for measure in MEASURES]
    by_seed = [runs.loc[runs["ok"]].set_index("seed").reindex(columns=names).astype(float) for runs in cells.values()]
    first, *others = (weight * numbers for weight, numbers in zip(weights, by_seed, strict=True))
    effects = sum(others, first)
    return tuple(spread(effects[name].dropna().tolist()) for name in names)
