"""Smallest models (`padgs smallest`): curves of quality over size, and the table."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pandas import DataFrame

from padgs.reports.conditions import OF_TIMES, footnotes, refuse_mixture
from padgs.reports.frame import by_conditions
from padgs.reports.selection import RunSet, settings
from padgs.reports.statistics import mean_cell
from padgs.reports.table import Block, Cell, Column, Row, Table
from padgs.results import SMALLEST_LOSSES, SMALLEST_PICTURE, SMALLEST_STATED

EPSILONS = tuple(f"{loss:g}" for loss in SMALLEST_LOSSES)  # dB, as results name them
STATED = f"{SMALLEST_STATED:g}"


@dataclass(frozen=True)
class Curve:
    """The sizes of one run's model, from large to small."""

    title: str  # of the method, with what sets it apart from others, and the seed where there are several
    method: str  # the same without the seed
    preset: str
    seed: int
    steps: tuple[Mapping[str, Any], ...]  # of `Result.smallest`, from large to small
    smallest: Mapping[str, Mapping[str, Any]]  # epsilon -> the smallest step that loses at most so much
    knee: Mapping[str, Any] | None
    found: Mapping[str, Any]  # all of `Result.smallest`
    image: Path | None = None  # as `padgs.results.SMALLEST_PICTURE` says, if there is one

    def values(self, name: str) -> list[float]:
        """A number of all steps; NaN where one has none."""
        return [np.nan if step[name] is None else step[name] for step in self.steps]

    @property
    def quality(self) -> list[float]:
        """WS-PSNR, dB, of all steps; see `quality_of`."""
        return [self.quality_of(step) for step in self.steps]

    def quality_of(self, step: Mapping[str, Any]) -> float:
        """Return the WS-PSNR of the searched run's test views less what a step loses there against the control, dB.

        Without test views, that of the validation views.
        """
        control, whole = self.found["steps"][0], self.found["test_ws_psnr"]
        if whole is None:
            return control["ws_psnr"] - step["loss"]
        return whole - (control["test_ws_psnr"] - step["test_ws_psnr"])


def searched(run_set: RunSet) -> DataFrame:
    """Return the runs with a search for their smallest model; each is a setting of its own."""
    runs = run_set.requested
    runs = runs.loc[runs["smallest"].map(bool)]
    return runs.assign(setting=runs["run"])


def curves(runs: DataFrame) -> list[Curve]:
    """A curve for each search on one scene, in the order of methods, of what sets their runs apart, and of seeds."""
    found = []
    for setting in settings(runs.sort_values("seed", kind="stable")):
        run, seeds = setting.runs.iloc[0], runs.loc[runs["preset"] == setting.preset, "seed"]
        steps = run["smallest"]["steps"]
        rows = sorted(steps, key=lambda step: -step["blended"])
        title = setting.title + (f", seed {run['seed']}" if seeds.nunique() > 1 else "")
        smallest = {epsilon: steps[number] for epsilon, number in run["smallest"]["minimal"].items()}
        knee = None if run["smallest"]["knee"] is None else steps[run["smallest"]["knee"]]
        image = None if run["renders"] is None else run["renders"].with_name(SMALLEST_PICTURE)
        there = image if image is not None and image.is_file() else None
        names = {"title": title, "method": setting.title, "preset": setting.preset, "seed": int(run["seed"])}
        found.append(
            Curve(**names, steps=tuple(rows), smallest=smallest, knee=knee, found=run["smallest"], image=there)
        )
    return found


def by_method(found: Sequence[Curve]) -> dict[str, list[Curve]]:
    """The curves of each method, one a seed."""
    methods = dict.fromkeys(one.method for one in found)
    return {method: [one for one in found if one.method == method] for method in methods}


def gain(ours: Curve, other: Curve) -> float | None:
    """Mean of our quality minus the other's at equal numbers of Gaussians, dB; None where no number is shared.

    Both are taken over log2 N, straight between the steps, where both have some (Bjontegaard's way without his cubic).
    """
    return _mean_difference(*(_points(curve.values("blended"), curve.quality) for curve in (ours, other)))


def ratio(ours: Curve, other: Curve) -> float | None:
    """Geometric mean of our number of Gaussians over the other's at equal quality; None where no quality is shared.

    Where more Gaussians are no better, the fewer are taken.
    """
    points = []
    for curve in (ours, other):
        sizes, qualities = _points(curve.values("blended"), curve.quality)
        best = np.maximum.accumulate(qualities)
        first = np.concatenate(([True], np.diff(best) > 0))
        points.append((best[first], sizes[first]))
    difference = _mean_difference(*points)
    return None if difference is None else 2.0**difference


def table(run_set: RunSet) -> Table:
    """Return a block for each scene, resolution and length, and a row for each method whose runs were searched.

    Raises:
        ReportError: results that must not stand together.
    """
    blocks, runs_of = [], {}
    for title, own in by_conditions(searched(run_set), "resolution", "length").items():
        refuse_mixture(own, run_set.request, title, OF_TIMES)
        found = by_method(curves(own))
        first = next(iter(found.values()))
        rows = (
            Row(method, tuple(_over_seeds(seeds, first, of) for of in COLUMNS.values()))
            for method, seeds in found.items()
        )
        blocks.append(Block(title, tuple(rows)))
        runs_of[title] = own
    notes = (*footnotes(runs_of, run_set.request.protocol), *NOTES) if blocks else ()
    return Table("smallest", "Smallest models", "Method", tuple(COLUMNS), tuple(blocks), notes)


def _over_seeds(seeds: Sequence[Curve], first: Sequence[Curve], of: Callable[[Curve, Curve], float | None]) -> Cell:
    """A number of the runs of a method, each beside that of the first method with its seed, if there is one."""
    beside = {one.seed: one for one in first}
    values = [of(one, beside.get(one.seed, first[0])) for one in seeds]
    return mean_cell([value for value in values if value is not None])


def _points(sizes: Sequence[float], qualities: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """From small to large: log2 of the sizes, and the qualities."""
    order = np.argsort(sizes, kind="stable")
    return np.log2(np.asarray(sizes, dtype=float))[order], np.asarray(qualities, dtype=float)[order]


def _mean_difference(ours: tuple[np.ndarray, np.ndarray], other: tuple[np.ndarray, np.ndarray]) -> float | None:
    """Mean of ours minus the other over the range of x that both (x ascending, y) have; exact for straight pieces."""
    low, high = max(ours[0][0], other[0][0]), min(ours[0][-1], other[0][-1])
    if not low < high:
        return None
    inner = [x for curve in (ours, other) for x in curve[0] if low < x < high]
    at = np.unique([low, *inner, high])
    difference = np.interp(at, *ours) - np.interp(at, *other)
    return float(np.sum((difference[1:] + difference[:-1]) / 2 * np.diff(at)) / (high - low))


COLUMNS: dict[Column, Callable[[Curve, Curve], float | None]] = {
    Column("Gaussians blended", 0): lambda own, _: own.found["steps"][0]["blended"],
    **{
        Column(f"minimal count for {epsilon} dB", 0, False): lambda own, _, e=epsilon: own.smallest[e]["blended"]
        for epsilon in EPSILONS
    },
    Column(f"share for {STATED} dB", 2): lambda own, _: own.smallest[STATED]["rows"] / own.found["rows"],
    Column("knee", 0): lambda own, _: None if own.knee is None else own.knee["blended"],
    Column(f"MB for {STATED} dB", 2, False): lambda own, _: own.smallest[STATED]["bytes"] / 1e6,
    Column(f"least ms of a frame for {STATED} dB", 1, False): lambda own, _: own.smallest[STATED]["frame_ms"],
    Column(f"WS-PSNR for {STATED} dB", 2, True): lambda own, _: own.quality_of(own.smallest[STATED]),
    Column("WS-PSNR of all", 2, True): lambda own, _: own.quality_of(own.found["steps"][0]),
    Column("dB at equal N against the first", 2, signed=True): gain,
    Column("N at equal dB over the first's", 2): ratio,
    Column("CPU s of the search", 0): lambda own, _: own.found["cpu_seconds"],
}
NOTES = (
    "Minimal count: Gaussians of the smallest model that is not inferior to a control, which was refined likewise and "
    "keeps all Gaussians, on validation views: WS-PSNR falls by at most so many dB with 95 % confidence, in a latitude "
    "band by twice and in a view by five times that, and LPIPS rises by at most 0.005. WS-PSNR: of the test views, "
    "which decide nothing, less what was lost there against the control. Not searched: offsets per anchor, features.",
    "Knee: the largest model below which a halving costs more than 0.1 dB. Beside the first: means over what both "
    "curves share.",
)
