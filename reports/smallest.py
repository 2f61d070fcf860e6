"""Smallest models of a quality (`padgs need`): curves of quality over size, and the table `need`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pandas import DataFrame

from padgs.reports.conditions import OF_TIMES, footnotes, refuse_mixture
from padgs.reports.frame import CONFIG, by_conditions
from padgs.reports.selection import RunSet, settings
from padgs.reports.statistics import mean_cell
from padgs.reports.table import Block, Cell, Column, Row, Table
from padgs.results import NEED_LOSSES, NEED_PICTURE, NEED_STATED

EPSILONS = tuple(f"{loss:g}" for loss in NEED_LOSSES)  # dB, as results name them
STATED = f"{NEED_STATED:g}"
DEGREE = f"{CONFIG}method.sh_degree"


@dataclass(frozen=True)
class Curve:
    """The sizes of one run's model, from large to small."""

    title: str  # of the method, with what sets it apart from others, and the seed where there are several
    method: str  # the same without the seed
    preset: str
    seed: int
    steps: tuple[Mapping[str, Any], ...]  # of `Result.need`, controls left out
    needs: Mapping[str, Mapping[str, Any]]  # epsilon -> the smallest step that loses at most so much
    knee: Mapping[str, Any] | None
    found: Mapping[str, Any]  # all of `Result.need`
    picture: Path | None = None  # as `padgs.results.NEED_PICTURE` says, if there is one

    def values(self, name: str) -> list[float]:
        """A number of all steps; NaN where one has none."""
        return [np.nan if step[name] is None else step[name] for step in self.steps]

    @property
    def degree(self) -> int | None:
        """Of the harmonics that are enough for `STATED`; None where that was not searched, or there are none."""
        steps = self.found.get("degrees", {}).get(STATED) or [{"degree": None, "objections": {STATED: ()}}]
        return [step["degree"] for step in steps if not step["objections"][STATED]][-1]

    @property
    def file(self) -> Mapping[str, Any] | None:
        """The smallest good file of the model that was kept, if that is the one for `STATED`."""
        return next(file for file in self.found["files"] if file["kept"]) if _is_stated(self.found) else None

    @property
    def quality(self) -> list[float]:
        """WS-PSNR, dB, of all steps; see `quality_of`."""
        return [self.quality_of(step) for step in self.steps]

    def quality_of(self, step: Mapping[str, Any]) -> float:
        """What the whole model shows of the test views, which decide nothing, less what was lost against the control.

        Both were trained on with fewer views than the whole model. Of the calibration views where there are no others.
        """
        steps = self.found["steps"]
        control = next(other for other in steps if other["kind"] != "prune" and other["depth"] == step["depth"])
        if step["test_ws_psnr"] is None:
            return steps[0]["ws_psnr"] - step["loss"]
        return steps[0]["test_ws_psnr"] - (control["test_ws_psnr"] - step["test_ws_psnr"])


def searched(run_set: RunSet) -> DataFrame:
    """The runs that `padgs need` made, one of each search, though it keeps one for each loss that it is asked for: that
    for `STATED`, if there is one. Each has a setting of its own, that of the run that was searched.
    """
    runs = run_set.requested
    runs = runs.loc[runs["need"].map(bool)]
    degrees = [_trained_degree(run) for _, run in runs.iterrows()]
    runs = runs.assign(
        variant="",  # which says what was kept
        setting=[name.partition("_need-")[0] for name in runs["run"]],  # the searched run
        **{DEGREE: pd.Series(degrees, index=runs.index, dtype=object)},
    )
    stated_first = sorted(runs.index, key=lambda index: not _is_stated(runs.at[index, "need"]))
    return runs.loc[stated_first].drop_duplicates("setting").sort_index()


def curves(runs: DataFrame) -> list[Curve]:
    """A curve for each search on one scene, in the order of methods, of what sets their runs apart, and of seeds."""
    found = []
    for setting in settings(runs.sort_values("seed", kind="stable")):
        run, seeds = setting.runs.iloc[0], runs.loc[runs["preset"] == setting.preset, "seed"]
        steps = run["need"]["steps"]
        rows = sorted((s for s in steps if s["kind"] != "control"), key=lambda step: -step["blended"])
        title = setting.title + (f", seed {run['seed']}" if seeds.nunique() > 1 else "")
        needs = {epsilon: steps[number] for epsilon, number in run["need"]["needs"].items()}
        knee = None if run["need"]["knee"] is None else steps[run["need"]["knee"]]
        picture = None if run["pictures"] is None else run["pictures"].with_name(NEED_PICTURE)
        there = picture if picture is not None and picture.is_file() else None
        names = {"title": title, "method": setting.title, "preset": setting.preset, "seed": int(run["seed"])}
        found.append(Curve(**names, steps=tuple(rows), needs=needs, knee=knee, found=run["need"], picture=there))
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
    return Table("need", "How many Gaussians a scene needs", "Method", tuple(COLUMNS), tuple(blocks), notes)


def _over_seeds(seeds: Sequence[Curve], first: Sequence[Curve], of: Callable[[Curve, Curve], float | None]) -> Cell:
    """A number of the runs of a method, each beside that of the first method with its seed, if there is one."""
    beside = {one.seed: one for one in first}
    values = [of(one, beside.get(one.seed, first[0])) for one in seeds]
    return mean_cell([value for value in values if value is not None])


def _is_stated(found: Mapping[str, Any]) -> bool:
    """Whether the model that a search kept is that for `STATED`."""
    return found.get("kept", {}).get("epsilon") == NEED_STATED


def _trained_degree(run: Any) -> Any:
    """Of the harmonics of the searched run; the configuration has that of the kept model, which may be less."""
    found = run["need"]
    if found.get("kept", {}).get("degree") is None:
        return run.get(DEGREE)
    return found["degrees"][f"{found['kept']['epsilon']:g}"][0]["degree"]


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
        Column(f"needed for {epsilon} dB", 0, False): lambda own, _, e=epsilon: own.needs[e]["blended"]
        for epsilon in EPSILONS
    },
    Column(f"share for {STATED} dB", 2): lambda own, _: own.needs[STATED]["rows"] / own.found["rows"],
    Column("knee", 0): lambda own, _: None if own.knee is None else own.knee["blended"],
    Column(f"MB for {STATED} dB", 2, False): lambda own, _: own.needs[STATED]["bytes"] / 1e6,
    Column(f"degree for {STATED} dB", 0, False): lambda own, _: own.degree,
    Column(f"MB of its file, {STATED} dB", 2, False): lambda own, _: (
        None if own.file is None else own.file["bytes"] / 1e6
    ),
    Column(f"least ms of a frame for {STATED} dB", 1, False): lambda own, _: own.needs[STATED]["frame_ms"],
    Column(f"WS-PSNR for {STATED} dB", 2, True): lambda own, _: own.quality_of(own.needs[STATED]),
    Column("WS-PSNR of all", 2, True): lambda own, _: own.quality_of(own.found["steps"][0]),
    Column("dB at equal N against the first", 2, signed=True): gain,
    Column("N at equal dB over the first's", 2): ratio,
    Column("CPU s of the search", 0): lambda own, _: own.found["cpu_seconds"],
}
NOTES = (
    "Needed: the smallest model as good as one that was refined as often and lost nothing, on views taken from the "
    "training: WS-PSNR by at most so many dB with 95 % confidence, each latitude band by twice and each view by five "
    "times that, LPIPS by 0.005. WS-PSNR: of the test views, which decide nothing, less what was lost there against a "
    "model refined as often. Not searched: offsets an anchor, features.",
    "Degree and file: of the model for that need, with as few harmonics and as small a file as lose no more against it "
    "with all of them and in full; the file was written, read back and measured.",
    "Knee: the largest model below which a halving costs more than 0.1 dB. Beside the first: means over what both "
    "curves share.",
)
