"""Smallest models of a quality (`padgs smallest`): curves of quality over size, and the table `smallest`."""

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
from padgs.reports.significance import mean_cell
from padgs.reports.table import Block, Cell, Column, Row, Table
from padgs.results import SMALLEST_LOSSES, SMALLEST_PICTURE, SMALLEST_STATED

STATED = f"{SMALLEST_STATED:g}"  # dB, as results name losses
NOTES = (
    "Minimal count: Gaussians of the smallest model that is not inferior to a control, which was refined likewise and "
    "keeps all Gaussians, on validation views: WS-PSNR falls by at most so many dB with 95 % confidence, in a latitude "
    "band by twice and in a view by five times that, and LPIPS rises by at most 0.005. WS-PSNR: of the test views, "
    "which decide nothing, less what was lost there against the control. Not searched: offsets per anchor, features.",
    "At least: the smallest model that is not known to lose more, with 95 % confidence; the interval of the minimal "
    "count begins there. By test views: the smallest model that loses no more on the test views.",
    "Knee: the largest model below which a halving costs more than 0.1 dB. Beside the first: means over what both "
    "curves share.",
)


@dataclass(frozen=True)
class Curve:
    """The candidates of a search on one run, from large to small."""

    title: str  # of the method, with its setting, and the seed if there are several
    method: str  # the same without the seed
    preset: str
    seed: int
    found: Mapping[str, Any]  # `Result.smallest`
    image: Path | None = None  # see `padgs.results.SMALLEST_PICTURE`

    @property
    def steps(self) -> list[Mapping[str, Any]]:
        """Candidates, the largest first."""
        return sorted(self.found["steps"], key=lambda step: -step["blended"])

    @property
    def smallest(self) -> dict[str, Mapping[str, Any]]:
        """Allowed loss, as text -> smallest model."""
        return {epsilon: self.found["steps"][number] for epsilon, number in self.found["minimal"].items()}

    @property
    def quality(self) -> list[float]:
        """Quality of the candidates, see `quality_of`."""
        return list(map(self.quality_of, self.steps))

    def values(self, name: str) -> list[float]:
        """Return a number of all candidates; NaN where missing."""
        return [np.nan if step[name] is None else step[name] for step in self.steps]

    def quality_of(self, step: Mapping[str, Any]) -> float:
        """Return WS-PSNR (dB) of the searched run less the loss of a candidate against the control, on test views.

        Without test views on validation views. The control was refined likewise, and kept all Gaussians.
        """
        control = self.found["steps"][0]
        if step["test_ws_psnr"] is None:
            return control["ws_psnr"] - step["loss"]
        return self.found["test_ws_psnr"] - (control["test_ws_psnr"] - step["test_ws_psnr"])


def searched(run_set: RunSet) -> DataFrame:
    """Return the runs on which `padgs smallest` was run."""
    runs = run_set.requested
    return runs.loc[["steps" in found for found in runs["smallest"]]]


def curves(runs: DataFrame) -> list[Curve]:
    """Return a curve for each run of one scene, in the order of methods, settings and seeds."""
    found = []
    for setting in settings(runs.sort_values("seed", kind="stable")):
        several = runs.loc[runs["preset"] == setting.preset, "seed"].nunique() > 1
        for run in setting.runs.to_dict("records"):
            title = setting.title + (f", seed {run['seed']}" if several else "")
            image = None if run["renders"] is None else run["renders"].with_name(SMALLEST_PICTURE)
            image = image if image is not None and image.is_file() else None
            found.append(Curve(title, setting.title, setting.preset, int(run["seed"]), run["smallest"], image))
    return found


def by_method(found: Sequence[Curve]) -> dict[str, list[Curve]]:
    """Return the curves of each method, one a seed."""
    methods = dict.fromkeys(one.method for one in found)
    return {method: [one for one in found if one.method == method] for method in methods}


def gain(ours: Curve, other: Curve) -> float | None:
    """Return the mean difference of quality at equal numbers of Gaussians, dB; None where the curves share none.

    Both are interpolated linearly over log2 N (the difference of Bjontegaard, without his cubic).
    """
    return _mean_difference(*(_points(curve.values("blended"), curve.quality) for curve in (ours, other)))


def ratio(ours: Curve, other: Curve) -> float | None:
    """Return the geometric mean ratio of numbers of Gaussians at equal quality; None where the curves share none.

    Where more Gaussians are no better, the smaller number counts.
    """
    points = []
    for curve in (ours, other):
        sizes, qualities = _points(curve.values("blended"), curve.quality)
        best = np.maximum.accumulate(qualities)
        first = np.concatenate(([True], np.diff(best) > 0))
        points.append((best[first], sizes[first]))
    difference = _mean_difference(*points)
    return None if difference is None else 2.0**difference


def _knee(own: Curve, _: Curve) -> float | None:
    return None if own.found["knee"] is None else own.found["steps"][own.found["knee"]]["blended"]


def _count(name: str) -> Callable[[Curve, Curve], float | None]:
    """Return the count of a candidate that `padgs smallest` names for the stated loss; None in results without it."""

    def count(own: Curve, _: Curve) -> float | None:
        number = own.found.get(name, {}).get(STATED)
        return None if number is None else own.found["steps"][number]["blended"]

    return count


COLUMNS: dict[Column, Callable[[Curve, Curve], float | None]] = {
    Column("Gaussians blended", 0): lambda own, _: own.found["steps"][0]["blended"],
    **{
        Column(f"minimal count for {loss:g} dB", 0, False): lambda own, _, e=f"{loss:g}": own.smallest[e]["blended"]
        for loss in SMALLEST_LOSSES
    },
    Column(f"at least, for {STATED} dB", 0): _count("possible"),
    Column(f"by test views, for {STATED} dB", 0): _count("by_test"),
    Column(f"share for {STATED} dB", 2): lambda own, _: own.smallest[STATED]["rows"] / own.found["rows"],
    Column("knee", 0): _knee,
    Column(f"MB for {STATED} dB", 2, False): lambda own, _: own.smallest[STATED]["bytes"] / 1e6,
    Column(f"least ms of a frame for {STATED} dB", 1, False): lambda own, _: own.smallest[STATED]["frame_ms"],
    Column(f"WS-PSNR for {STATED} dB", 2, True): lambda own, _: own.quality_of(own.smallest[STATED]),
    Column("WS-PSNR of all", 2, True): lambda own, _: own.quality_of(own.found["steps"][0]),
    Column("dB at equal N against the first", 2, signed=True): gain,
    Column("N at equal dB over the first's", 2): ratio,
    Column("CPU s of the search", 0): lambda own, _: own.found["cpu_seconds"],
}


def table(run_set: RunSet) -> Table:
    """Return a block for each scene, resolution and length, and a row for each method whose runs were searched.

    Raises:
        ReportError: runs must not be compared, or are mixed in a cell.
    """
    blocks, shown = [], {}
    for title, own in by_conditions(searched(run_set), "resolution", "length").items():
        refuse_mixture(own, run_set.request, title, OF_TIMES)
        found = by_method(curves(own))
        first = {one.seed: one for one in next(iter(found.values()))}
        rows = (Row(of, tuple(_over_seeds(seeds, first, n) for n in COLUMNS.values())) for of, seeds in found.items())
        blocks.append(Block(title, tuple(rows)))
        shown[title] = own
    notes = (*footnotes(shown, run_set.request.protocol), *NOTES) if blocks else ()
    return Table("smallest", "Smallest models", "Method", tuple(COLUMNS), tuple(blocks), notes)


def _over_seeds(
    curves: Sequence[Curve], first: Mapping[int, Curve], number: Callable[[Curve, Curve], float | None]
) -> Cell:
    """Return the mean over seeds, each beside the first method's curve of its seed, or else its first curve."""
    values = [number(one, first.get(one.seed, next(iter(first.values())))) for one in curves]
    return mean_cell([value for value in values if value is not None])


def _points(sizes: Sequence[float], qualities: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Return log2 of the sizes in ascending order, and the qualities."""
    order = np.argsort(sizes, kind="stable")
    return np.log2(np.asarray(sizes, dtype=float))[order], np.asarray(qualities, dtype=float)[order]


def _mean_difference(ours: tuple[np.ndarray, np.ndarray], other: tuple[np.ndarray, np.ndarray]) -> float | None:
    """Return the mean of ours minus the other over their common range of x (ascending); exact for straight pieces."""
    low, high = max(ours[0][0], other[0][0]), min(ours[0][-1], other[0][-1])
    if not low < high:
        return None
    inner = [x for curve in (ours, other) for x in curve[0] if low < x < high]
    at = np.unique([low, *inner, high])
    from scipy.integrate import trapezoid

    return float(trapezoid(np.interp(at, *ours) - np.interp(at, *other), at) / (high - low))
