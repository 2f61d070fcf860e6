"""Smallest models of a quality (`padgs smallest`): a table, and charts of quality over Gaussians, bytes and time."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pandas import DataFrame

from padgs.reports.charts.drawing import INK, MARKERS, Chart, color_of, figure, lay_out, set_axis, spans, styled
from padgs.reports.conditions import OF_TIMES, footnotes, sheets
from padgs.reports.frame import SEARCHED_ON
from padgs.reports.selection import RunSet, one_setting, settings
from padgs.reports.significance import mean_cell
from padgs.reports.specs import SPECS
from padgs.reports.table import Block, Column, Row, Table
from padgs.results import SMALLEST_LOSSES, SMALLEST_PICTURED, SMALLEST_STATED

STATED = f"{SMALLEST_STATED:g}"  # dB, as results name losses
PANELS = (("blended", "Gaussians blended", 1), ("bytes", "model, MB", 1e-6), ("frame_ms", "minimal ms per frame", 1))
LOSSES = tuple(f"{loss:g}" for loss in SMALLEST_PICTURED)  # dB, marked in the chart by a ring and a square
LOG_RATIO = 1.5  # largest over smallest size, from which an axis is logarithmic
NOTES = (
    "Minimal count: Gaussians of the smallest model that is not inferior to a control, which was refined likewise and "
    "keeps all Gaussians, on the test views: WS-PSNR falls by at most so many dB with 95 % confidence, in a latitude "
    "band by twice and in a view by five times that, and LPIPS rises by at most 0.005. WS-PSNR: of the whole model, "
    "less what was lost against the control. Not searched: offsets per anchor, features.",
    "At least: the smallest model that is not known to lose more, with 95 % confidence; the interval of the minimal "
    "count begins there.",
)


@dataclass(frozen=True)
class Curve:
    """The candidates of a search on one run, from large to small."""

    title: str  # of the method, with its setting, and the seed if there are several
    method: str  # the same without the seed
    preset: str
    found: Mapping[str, Any]  # `Result.smallest`

    @property
    def steps(self) -> list[Mapping[str, Any]]:
        """Candidates, the largest first."""
        return sorted(self.found["steps"], key=lambda step: -step["blended"])

    @property
    def smallest(self) -> dict[str, Mapping[str, Any]]:
        """Allowed loss, as text -> smallest model."""
        return {epsilon: self.found["steps"][number] for epsilon, number in self.found["minimal"].items()}

    def quality_of(self, step: Mapping[str, Any]) -> float:
        """Return WS-PSNR (dB) of the searched run less the loss of a candidate against the control.

        The control was refined likewise, and kept all Gaussians.
        """
        return self.found["ws_psnr"] - step["loss"]


def searched(run_set: RunSet) -> DataFrame:
    """Return the runs on which `padgs smallest` was run."""
    runs = run_set.requested
    return runs.loc[["steps" in found for found in runs["smallest"]]]


def curves(runs: DataFrame) -> list[Curve]:
    """Return a curve for each run of one scene, in the order of methods, settings and seeds."""
    found = []
    for setting in settings(runs.sort_values("seed", kind="stable")):
        several = runs.loc[runs["preset"] == setting.preset, "seed"].nunique() > 1
        for run in one_setting(setting.runs, setting.title).to_dict("records"):
            title = setting.title + (f", seed {run['seed']}" if several else "")
            found.append(Curve(title, setting.title, setting.preset, run["smallest"]))
    return found


def by_method(found: Sequence[Curve]) -> dict[str, list[Curve]]:
    """Return the curves of each method, one a seed."""
    methods = dict.fromkeys(one.method for one in found)
    return {method: [one for one in found if one.method == method] for method in methods}


COLUMNS: dict[Column, Callable[[Curve], float | None]] = {
    Column("Gaussians blended", 0): lambda own: own.found["steps"][0]["blended"],
    **{
        Column(f"minimal count for {loss:g} dB", 0, False): lambda own, e=f"{loss:g}": own.smallest[e]["blended"]
        for loss in SMALLEST_LOSSES
    },
    Column(f"at least, for {STATED} dB", 0): lambda own: own.found["steps"][own.found["possible"][STATED]]["blended"],
    Column(f"share for {STATED} dB", 2): lambda own: own.smallest[STATED]["rows"] / own.found["rows"],
    Column(f"MB for {STATED} dB", 2, False): lambda own: own.smallest[STATED]["bytes"] / 1e6,
    Column(f"least ms of a frame for {STATED} dB", 1, False): lambda own: own.smallest[STATED]["frame_ms"],
    Column(f"WS-PSNR for {STATED} dB", 2, True): lambda own: own.quality_of(own.smallest[STATED]),
    Column("WS-PSNR of all", 2, True): lambda own: own.quality_of(own.found["steps"][0]),
    Column("CPU s of the search", 0): lambda own: own.found["cpu_seconds"],
}


def table(run_set: RunSet) -> Table:
    """Return a block for each scene, resolution and length, and a row for each method whose runs were searched."""
    blocks, shown, more = [], {}, []
    for _, title, own in sheets(searched(run_set), run_set.request, "smallest", (*OF_TIMES, SEARCHED_ON)):
        rows = []
        for method, seeds in by_method(curves(own)).items():
            known = ([n for n in map(number, seeds) if n is not None] for number in COLUMNS.values())
            rows.append(Row(method, tuple(map(mean_cell, known))))
            if any(step["lpips"] is None for seed in seeds for step in seed.steps):
                more.append(f"{title}, {method}: LPIPS was not measured, and did not decide.")
        elsewhere = own.loc[own[SEARCHED_ON] != own["machine"], SEARCHED_ON].unique()
        more += [f"{title}: searched on {where}." for where in elsewhere]
        blocks.append(Block(title, tuple(rows)))
        shown[title] = own
    notes = (*footnotes(shown, run_set.request.protocol), *more, *NOTES, *SPECS["table3"].notes) if blocks else ()
    return Table("smallest", "Smallest models", "Method", tuple(COLUMNS), tuple(blocks), notes)


def charts(run_set: RunSet) -> list[Chart]:
    """Return a chart for each scene that was searched."""
    found = []
    for name, title, own in sheets(searched(run_set), run_set.request, "smallest", (*OF_TIMES, SEARCHED_ON)):
        notes = tuple(footnotes({title: own}, run_set.request.protocol))
        found.append(_chart(name, title, curves(own), notes))
    return found


@styled()
def _chart(name: str, title: str, found: list[Curve], notes: tuple[str, ...]) -> Chart:
    made, axes = figure(len(PANELS), 1, 3.6, 3.4)
    presets = [curve.preset for curve in found]
    for panel, (quantity, words, unit) in zip(axes.flat, PANELS, strict=True):
        sizes = [unit * step[quantity] for curve in found for step in curve.steps]
        set_axis(panel.xaxis, sizes, spans(sizes, LOG_RATIO))
        for method, seeds in by_method(found).items():
            color = color_of(seeds[0].preset, presets)
            for curve in seeds:
                _draw(panel, curve, quantity, unit, color, first=curve is seeds[0])
            panel.plot([], [], color=color, label=method)
        panel.set_xlabel(words)
    axes[0, 0].set_ylabel("WS-PSNR of test views, dB ↑")
    made.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    marks = f"ring: smallest for a loss of {LOSSES[0]} dB, square: {LOSSES[1]} dB"
    marks += "; thin: further seeds" if len(found) > len(by_method(found)) else ""
    what = f"{title}\nsmaller models of the same run; {marks}"
    lay_out(made, what)
    return Chart(name, what, made, notes, _numbers(name, found))


def _draw(panel: Any, curve: Curve, quantity: str, unit: float, color: str, *, first: bool) -> None:
    """Draw a curve; further seeds of a method are thinner."""
    xs = [unit * step[quantity] for step in curve.steps]
    ys = list(map(curve.quality_of, curve.steps))
    panel.plot(*zip(*sorted(zip(xs, ys, strict=True)), strict=True), color=color, linewidth=1.2 if first else 0.6)
    for step, x, y in zip(curve.steps, xs, ys, strict=True):
        panel.plot([x], [y], MARKERS[0], color=color, markersize=4 if first else 2.5)
        for loss, around in zip(LOSSES, MARKERS, strict=False):
            if curve.smallest.get(loss) is step:
                panel.plot([x], [y], around, markersize=9, fillstyle="none", color=INK, markeredgewidth=1)


def _numbers(name: str, found: list[Curve]) -> DataFrame:
    quantities = ("rows", "blended", "bytes", "frame_ms", "loss", "ws_psnr", "lpips")
    rows = [
        {"chart": name, "curve": curve.title, "preset": curve.preset, **{q: step[q] for q in quantities}}
        | {"smallest for": " ".join(loss for loss, at in curve.smallest.items() if at is step)}
        for curve in found
        for step in curve.steps
    ]
    return DataFrame(rows, dtype=object)
