"""Charts of speed against accuracy: quality over training time and over time per frame, and over time from the logs."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from textwrap import wrap
from typing import Any

import numpy as np
from pandas import DataFrame, Series

from padgs.reports import methods
from padgs.reports.charts import drawing
from padgs.reports.charts.drawing import INK, SOFT, Chart, Label, color_of, set_axis, styled, weight_of, write_labels
from padgs.reports.charts.trade_off import Point, TradeOff, equal_times, pareto, trade_offs
from padgs.reports.conditions import unranked
from padgs.reports.measures import COSTS
from padgs.reports.selection import RunSet, Setting, settings

Cost = tuple[str, str, str]  # name, words, unit
FRAME_TIME = ("frame_ms", "time per frame", "ms")
TRAINING_TIME, CPU_TIME = ("train_seconds", "training time", "s"), ("cpu_seconds", "training time on the CPU", "s")
SIZE, TIME_SIZE = (5.3, 4.6), (10.6, 4.2)  # inches of a panel, and of a chart of quality over time
AREA, SMALL_AREA = 90.0, 30.0  # points^2 of marks, and of those of releases
LOOKS: dict[str, dict[str, Any]] = {  # role of a preset -> look of its line over time
    "main": {"linewidth": 1.3, "zorder": 2.2},
    "variant": {"linewidth": 0.9, "zorder": 2.1},
    "release": {"linewidth": 0.7, "zorder": 2.0, "linestyle": (0, (4, 2))},
}
NAMED, DIP = 5, 0.5  # names in a chart over time; dB of a dip that is left out
LINE = 90  # characters below a panel
END_RADIUS = 2.5  # points, of the mark at the end of a run
SPACING = 5.0  # pixels between places on a line that labels avoid


@dataclass(frozen=True)
class Mark:
    """A point in a panel."""

    point: Point
    role: str  # see `TradeOff.role`
    x: float  # cost
    y: float  # quality

    @property
    def radius(self) -> float:
        """Points."""
        return math.sqrt(SMALL_AREA if self.role == "release" else AREA) / 2


def charts(run_set: RunSet) -> list[Chart]:
    """Return speed against accuracy, and quality over training time for runs with a log."""
    made = [drawn for trade_off in trade_offs(run_set) for drawn in (chart(trade_off), time_chart(trade_off))]
    return [drawn for drawn in made if drawn is not None]


def equal_time_charts(run_set: RunSet) -> list[Chart]:
    """Return quality over time per frame after the same training time, for each scene, resolution and training time."""
    return [chart(trade_off, (FRAME_TIME,)) for trade_off in equal_times(run_set)]


def chart(trade_off: TradeOff, shown: Sequence[Cost] = ()) -> Chart:
    """Return panels with a common axis of quality and a label at each mark, by default of training and of frame time.

    Axes show where methods differ (`drawing.window`); a note names the marks beyond. Releases are small rings, outside
    of the Pareto front. Variants are faint.
    """
    made, panels = draw(trade_off, shown)
    notes = (*trade_off.notes, *_beyond((axes, marks, unit) for axes, marks, unit, _ in panels))
    return Chart(trade_off.name, trade_off.title, made, notes, trade_off.numbers)


@styled()
def draw(trade_off: TradeOff, shown: Sequence[Cost] = ()) -> tuple[Any, list[tuple[Any, list[Mark], str, list[Any]]]]:
    """Return the figure, and for each panel the axes, the marks, the unit of the cost and the labels."""
    quality = trade_off.quality
    shown = shown or (CPU_TIME if trade_off.on_cpu else TRAINING_TIME, FRAME_TIME)
    made, axes = drawing.figure(len(shown), 1, *SIZE)
    marks = [_marks(trade_off, cost) for cost, _, _ in shown]
    presets = [point.preset for point in trade_off.points]
    apart = unranked(trade_off.runs)
    for panel, own, (cost, words, unit) in zip(axes.flat, marks, shown, strict=True):
        panel.set_xlabel(f"{words}, {unit}, log scale ↓")
        panel.set_ylabel(f"{quality.column.title}, dB ↑")
        set_axis(panel.xaxis, [mark.x for mark in own], True, worse=1)
        set_axis(panel.yaxis, [mark.y for of in marks for mark in of], worse=-1)
        rivals = [m for m in own if m.role != "release" and m.point.preset not in apart]
        _draw_front(panel, [(mark.x, mark.y) for mark in rivals])
        for mark in own:
            _draw(panel, trade_off, mark, COSTS[cost].column.title, presets)
    panels = [(panel, own, unit) for panel, own, (_, _, unit) in zip(axes.flat, marks, shown, strict=True)]
    beyond = wrap(" ".join(_beyond(panels)), LINE * len(shown))
    look = {"title": "\n".join([_conditions(trade_off), *beyond]), "ncols": 8, "fontsize": 8, "title_fontsize": 8}
    made.legend(handles=_handles([mark for of in marks for mark in of]), loc="outside lower center", **look)
    drawing.lay_out(made, trade_off.title)
    return made, [(panel, own, unit, _label(panel, own)) for panel, own, unit in panels]


@styled()
def time_chart(trade_off: TradeOff) -> Chart | None:
    """Return held-out PSNR over training seconds, with a label where a run ends; None if no run has a log.

    The axis of quality shows the later halves of the runs (`drawing.window`) and the best of each. Releases are dashed.
    `NAMED` methods have a colour and a name at their best setting; dips after resets of opacities are left out.
    """
    if not (curves := _curves(trade_off)):
        return None
    made, axes = drawing.figure(1, 1, *TIME_SIZE)
    panel, presets, labels = axes[0, 0], [setting.preset for setting, _, _ in curves], []
    later = [value for _, _, psnr in curves for value in (*psnr[len(psnr) // 2 :], max(psnr))]
    low, high = set_axis(panel.yaxis, later, worse=-1)
    points = [point for _, seconds, psnr in curves for point in zip(seconds, psnr, strict=True)]
    set_axis(panel.xaxis, [s for s, value in points if s > 0 and low <= value <= high], logarithmic=True)
    named = _named(trade_off, curves, low, high)
    for setting, seconds, psnr in curves:
        title, preset, role = setting.title, setting.preset, trade_off.role(setting.preset)
        color = color_of(preset, presets) if preset in named else SOFT
        look = {"color": color, "alpha": drawing.ALPHA[role]} | LOOKS[role]
        panel.plot(seconds, psnr, **look)
        panel.plot(seconds[-1], psnr[-1], **look, marker="o", markersize=2 * END_RADIUS)
        if named.get(preset) == title:
            text = methods.short(title, preset)
            labels.append(Label(text, (seconds[-1], psnr[-1]), END_RADIUS, weight_of(preset, role), color))
    time = "training time on the CPU" if trade_off.on_cpu else "training time"
    panel.set_xlabel(f"{time} in seconds, evaluations not counted")
    panel.set_ylabel("PSNR of a held-out view, dB ↑")
    meaning = "without dips after resets; grey: other methods, dashed: as released"
    title = f"{trade_off.title}\nquality over training time, {meaning}"
    drawing.lay_out(made, title)
    ends = [(seconds[-1], psnr[-1], END_RADIUS) for _, seconds, psnr in curves]
    write_labels(panel, labels, [*ends, *_along(panel)])
    lost = "; ".join(sorted({point.title for point in trade_off.points} - {setting.title for setting, _, _ in curves}))
    notes = [f"Without logs in all scenes, so without a line: {lost}."] if lost else []
    if absent := [run for of, _, _ in curves for run in of.runs.loc[~_has_log(of.runs), "run"]]:
        notes.append(f"Without a complete log, so in no line: {', '.join(absent)}.")
    return Chart(trade_off.name.replace("chart_", "time_", 1), title, made, (*trade_off.notes, *notes))


def _along(panel: Any) -> list[tuple[float, float, float]]:
    """Return marks along the lines of a panel, which labels avoid."""
    transform, marks = panel.transData, []
    for line in panel.lines:
        for a, b in pairwise(transform.transform(line.get_xydata())):
            places = np.linspace(a, b, 2 + int(np.linalg.norm(b - a) / SPACING), endpoint=False)
            marks += [(x, y, END_RADIUS) for x, y in transform.inverted().transform(places)]
    return marks


def _named(trade_off: TradeOff, curves: Sequence[Any], low: float, high: float) -> dict[str, str]:
    """Return the best setting within the axis of `NAMED` methods: preset -> title; ours and main presets first."""
    best: dict[str, tuple[Any, ...]] = {}
    for setting, _, psnr in curves:
        role = trade_off.role(setting.preset)
        if role != "release" and low <= psnr[-1] <= high:
            rank = (weight_of(setting.preset, role) != "bold", role != "main", -psnr[-1], setting.title)
            best[setting.preset] = min(rank, best.get(setting.preset, rank))
    return {preset: best[preset][-1] for preset in sorted(best, key=best.__getitem__)[:NAMED]}


def _curves(trade_off: TradeOff) -> list[tuple[Setting, list[float], list[float]]]:
    """Return seconds and PSNR of each setting, evaluation by evaluation: means over scenes, of means over seeds.

    Runs of a time differ in iterations, so both are interpolated at equal shares of the iterations done. Runs without a
    complete log are left out, and settings without a run in a scene. Logs have wall time, which is scaled so that it
    ends with the run's CPU time where that is known.
    """
    found = []
    for setting in settings(trade_off.runs.loc[trade_off.runs["ok"]]):
        runs = setting.runs.loc[_has_log(setting.runs)]
        of_scenes: dict[Any, list[Any]] = {place: [] for place in trade_off.runs["place"].unique()}
        shares = [np.array(log["iteration"]) / log["iteration"][-1] for log in runs["log"]]
        grid = max(shares, key=len, default=np.zeros(0))
        grid = grid[grid >= max((share[0] for share in shares), default=0)]
        scales = (runs["train_seconds"] / runs["wall_seconds"]).fillna(1.0)
        for place, log, share, scale in zip(runs["place"], runs["log"], shares, scales, strict=True):
            seconds = np.interp(grid, share, scale * np.array(log["seconds"]))
            of_scenes[place].append((seconds, np.interp(grid, share, log["psnr"])))
        if all(of_scenes.values()):
            seconds, psnr = np.mean([np.mean(of, axis=0) for of in of_scenes.values()], axis=0).tolist()
            found.append((setting, *without_dips(seconds, psnr)))
    return found


def _has_log(runs: DataFrame) -> Series:
    """Return which runs have a log that reaches their last iteration."""
    return runs["iterations_done"] == [log["iteration"][-1] if log["iteration"] else math.nan for log in runs["log"]]


def without_dips(seconds: Sequence[float], psnr: Sequence[float]) -> tuple[list[float], list[float]]:
    """Leave out points more than `DIP` below both an earlier and a later one, as after a reset of opacities.

    >>> without_dips([1, 2, 3, 4], [20.0, 12.0, 21.0, 18.0])
    ([1, 3, 4], [20.0, 21.0, 18.0])
    """
    before = np.maximum.accumulate(psnr)
    after = np.maximum.accumulate(psnr[::-1])[::-1]
    kept = [n for n, value in enumerate(psnr) if min(before[n], after[n]) - value <= DIP]
    return [seconds[n] for n in kept], [psnr[n] for n in kept]


def _marks(trade_off: TradeOff, cost: str) -> list[Mark]:
    """Return a mark for each point with a quality and a positive cost."""
    numbers = [(point, point.value(COSTS[cost]), point.value(trade_off.quality)) for point in trade_off.points]
    return [Mark(point, trade_off.role(point.preset), x, y) for point, x, y in numbers if x and y is not None]


def _beyond(panels: Iterable[tuple[Any, Sequence[Mark], str]]) -> list[str]:
    """Return a sentence that names the marks outside of axes; empty if there are none."""
    found = set()
    for mark, unit in ((mark, unit) for axes, marks, unit in panels for mark in marks if not _inside(axes, mark)):
        cost = f"{mark.x:,.0f}" if mark.x >= 1000 else f"{mark.x:.3g}"  # all digits before the point
        found.add(f"{mark.point.title} ({mark.y:.1f} dB, {cost} {unit})")
    return [f"Beyond the axes: {'; '.join(sorted(found))}."] if found else []


def _inside(panel: Any, mark: Mark) -> bool:
    (left, right), (bottom, top) = panel.get_xlim(), panel.get_ylim()
    return left <= mark.x <= right and bottom <= mark.y <= top


def _draw(panel: Any, trade_off: TradeOff, mark: Mark, cost: str, presets: Sequence[str]) -> None:
    """Draw a mark, with its standard deviation along both axes."""
    color, numbers = color_of(mark.point.preset, presets), mark.point.numbers
    x_std, y_std = numbers[cost].std, numbers[trade_off.quality.column.title].std
    if x_std or y_std:
        x_std = [[min(x_std or 0.0, 0.9 * mark.x)], [x_std or 0.0]]  # a logarithmic axis has no zero
        look = {"color": color, "linewidth": 0.8, "alpha": 0.6 * drawing.ALPHA[mark.role], "zorder": 2}
        panel.errorbar(mark.x, mark.y, yerr=y_std, xerr=x_std, linestyle="none", **look)
    look = {"alpha": drawing.ALPHA[mark.role], "zorder": 3 if mark.role == "main" else 2.5}
    if mark.role == "release":
        look |= {"facecolors": "none", "edgecolors": color, "linewidths": 1.0}
    else:
        ours = weight_of(mark.point.preset, mark.role) == "bold"
        look |= {"facecolors": color, "edgecolors": INK if ours else drawing.PAPER, "linewidths": 1.2 if ours else 0.5}
    panel.scatter(mark.x, mark.y, s=(2 * mark.radius) ** 2, **look)


def _draw_front(panel: Any, points: Sequence[tuple[float, float]]) -> None:
    if corners := pareto(points):
        corners.append((max(panel.get_xlim()[1], corners[-1][0]), corners[-1][1]))
        panel.step(*zip(*corners, strict=True), where="post", color=SOFT, linewidth=0.9, zorder=1.5)


def _label(panel: Any, marks: Sequence[Mark]) -> list[Any]:
    """Write labels, main presets first, and return the texts; call it when the layout is fixed."""
    inside = [mark for mark in marks if _inside(panel, mark)]
    labels = [
        Label(methods.short(m.point.title, m.point.preset), (m.x, m.y), m.radius, weight_of(m.point.preset, m.role))
        for m in sorted(inside, key=lambda mark: mark.role != "main")
    ]
    return write_labels(panel, labels, [(mark.x, mark.y, mark.radius) for mark in inside])


def _handles(marks: Sequence[Mark]) -> list[Any]:
    from matplotlib.lines import Line2D

    dot, roles = {"marker": "o", "color": SOFT, "linestyle": "none"}, {mark.role for mark in marks}
    faint = {"markersize": math.sqrt(AREA), "markeredgewidth": 0, "alpha": drawing.ALPHA["variant"]}
    ring = {"markersize": math.sqrt(SMALL_AREA), "markeredgewidth": 1.0, "markerfacecolor": "none"}
    known = {"variant": faint | {"label": "variant of a method"}, "release": ring | {"label": "program as released"}}
    handles = [Line2D([], [], **dot, **look) for role, look in known.items() if role in roles]
    return [*handles, Line2D([], [], color=SOFT, linewidth=0.9, label="Pareto front")]


def _conditions(trade_off: TradeOff) -> str:
    """Return the conditions that all runs share, so that the image can be read alone."""
    known = (trade_off.runs[column].unique() for column in ("resolution", "length"))  # no length of external models
    shared = [values[0] for values in known if len(values) == 1 and values[0]]
    counts = {cell.count for point in trade_off.points for cell in point.numbers.values() if cell.std is not None}
    seeds = " to ".join(map(str, sorted({min(counts), max(counts)}))) if counts else ""
    bars = [f"bars: standard deviation over {seeds} seeds"] if seeds else []
    return ", ".join(["up and to the left is better", *shared, *bars])
