"""The picture of speed against accuracy, and that of quality over training time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from reports import methods, published
from reports.charts.drawing import Chart, Tips, color_of, dress, figure, finish, marker_of, styled
from reports.charts.trade_off import COSTS, Point, TradeOff, pareto, trade_offs
from reports.frame import by_place
from reports.gathered import Gathered
from reports.measures import Measure
from reports.published import Key
from reports.settings import settings

AREA = 60.0  # points^2 of a marker with the median number of Gaussians
SMALLEST, LARGEST = 45.0, 700.0
WITHOUT_GAUSSIANS = 25.0
PUBLISHED = (  # metric and cost of the paper, how to read the cost
    ("psnr", "PSNR ↑", True),
    ("lpips", "LPIPS ↓", False),
)
PUBLISHED_COSTS = (("fps", "ms per frame ↓", lambda fps: 1000 / fps), ("train_hours", "training h ↓", lambda h: h))


def charts(gathered: Gathered) -> list[Chart]:
    """Speed against accuracy, and quality over training time where runs left a log."""
    made = [drawn for trade_off in trade_offs(gathered) for drawn in (chart(trade_off), time_chart(trade_off))]
    return [drawn for drawn in made if drawn is not None]


@styled
def chart(trade_off: TradeOff) -> Chart:
    """Two rows of panels: measured quality against four costs, and the published numbers on axes of their own."""
    presets = methods.ordered(point.preset for point in trade_off.points)
    made, axes = figure(len(COSTS) + len(PUBLISHED_COSTS), 2, 2.75, 2.7)
    tips = Tips()
    area = _area(trade_off.points)
    for row, quality in enumerate(trade_off.qualities):
        for index, cost in enumerate(COSTS):
            _measured(axes[row, index], trade_off.points, cost, quality, presets, area, tips)
        for index in range(len(PUBLISHED_COSTS)):
            _published(axes[row, len(COSTS) + index], trade_off.beside, row, index, presets, tips)
    for preset in presets:
        style = {"color": color_of(preset, presets), "marker": marker_of(preset, presets), "linestyle": "none"}
        axes[0, 0].plot([], [], label=methods.title(preset), **style)
    made.legend(loc="outside lower center", ncols=6)
    title = f"{trade_off.title}\nfilled: measured here, area = Gaussians, line = Pareto front; hollow: published"
    title += f", {published.TITLES[trade_off.beside]}, one RTX 3090 Ti"
    return finish(made, trade_off.name, title, tips, trade_off.notes, trade_off.numbers)


@styled
def time_chart(trade_off: TradeOff) -> Chart | None:
    """Held-out PSNR over training seconds; None where no run left a log.

    A line for each run of one scene; of the scenes of a data set, whose lines would bury each other, the first seed.
    """
    made, axes = figure(1, 1, 7.5, 3.6)
    panel, tips = axes[0, 0], Tips()
    presets = methods.ordered(trade_off.runs["preset"])
    drawn: dict[str, None] = {}
    ends: list[float] = []
    by_scene = by_place(trade_off.runs)
    for setting in (setting for runs in by_scene.values() for setting in settings(runs)):
        color, marker = color_of(setting.preset, presets), marker_of(setting.preset, presets)
        shown = setting.runs[: 1 if len(by_scene) > 1 else None]
        for log, scene, seed in zip(shown["log"], shown["scene"], shown["seed"], strict=True):
            xs, ys = log["seconds"], log["psnr"]
            if not ys:
                continue
            label = None if setting.title in drawn else setting.title
            drawn[setting.title] = None
            panel.plot(xs, ys, color=color, linewidth=1.1, alpha=0.8, label=label)
            ends.append(xs[-1])
            tip = tips.add(f"{setting.title}, {scene}, seed {seed}\n{ys[-1]:.2f} dB after {xs[-1]:.0f} s")
            panel.plot(xs[-1:], ys[-1:], marker, color=color, markersize=5, gid=tip)
    if not drawn:
        return None
    dress(panel.xaxis, ends, log_from=8)
    panel.set_xlabel("training time in seconds, rendering of probes not counted")
    panel.set_ylabel("PSNR of a held-out view, dB")
    made.legend(loc="outside right center", fontsize=8)
    name, title = trade_off.name.replace("chart_", "time_", 1), f"{trade_off.title}\nquality over training time"
    return finish(made, name, title, tips, trade_off.notes)


def _measured(
    panel: Any, points: Sequence[Point], cost: Measure, quality: Measure, presets: list[str], area: Any, tips: Tips
) -> None:
    there = []
    for point in points:
        x, y = point.numbers[cost.column.title], point.numbers[quality.column.title]
        color, marker = color_of(point.preset, presets), marker_of(point.preset, presets)
        if x.value is None or y.value is None or not math.isfinite(y.value):
            continue
        lines = [point.title, *(f"{t}: {_brief(c.value)}" for t, c in point.numbers.items() if c.value is not None)]
        there.append((x.value, y.value))
        panel.errorbar([x.value], [y.value], xerr=x.std, yerr=y.std, color=color, linewidth=0.8, linestyle="none")
        style = {"s": area(point), "color": color, "marker": marker, "alpha": 0.75}
        panel.scatter([x.value], [y.value], linewidths=0.0, gid=tips.add("\n".join(lines)), **style)
    front = pareto(there, bool(quality.column.higher_is_better))
    panel.plot(
        *zip(*front, strict=True) if front else ((), ()),
        color="#666666",
        linewidth=0.9,
        drawstyle="steps-post",
        zorder=1,
    )
    dress(panel.xaxis, [x for x, _ in there], log_from=3)
    panel.margins(0.12)
    panel.set_xlabel(cost.column.heading)
    panel.set_ylabel(quality.column.heading)


def _published(panel: Any, dataset: str, row: int, index: int, presets: list[str], tips: Tips) -> None:
    metric, title, higher = PUBLISHED[row]
    name, cost_title, of = PUBLISHED_COSTS[index]
    numbers, theirs = published.load(), published.DATASETS[dataset]
    table = {"roam360": 1, "ricoh360": 2}[dataset]
    there = []
    for method in methods.TITLES:
        quality = numbers.get(Key(table, theirs, "average", method, metric))
        cost = numbers.get(Key(4, theirs, "average", method, name))
        if quality is None or cost is None or quality.value is None or not cost.value:
            continue
        x, y = of(cost.value), quality.value
        there.append((x, y))
        color = color_of(method, presets)
        marker = marker_of(method, presets)
        tip = tips.add(f"{methods.name(method)}, published\n{title}: {y}\n{cost_title}: {x:.3g}")
        panel.scatter([x], [y], s=40, facecolors="none", edgecolors=color, marker=marker, linewidths=1.3, gid=tip)
        panel.annotate(methods.name(method), (x, y), textcoords="offset points", xytext=(4, 4), fontsize=6.5)
    panel.plot(
        *zip(*pareto(there, higher), strict=True), color="#bbbbbb", linewidth=0.9, drawstyle="steps-post", zorder=1
    )
    dress(panel.xaxis, [x for x, _ in there], log_from=3)
    panel.margins(x=0.2, y=0.12)
    panel.set_facecolor("#fafafa")
    panel.set_xlabel(f"{cost_title} (published)")
    panel.set_ylabel(f"{title} (published)")


def _brief(value: float) -> str:
    """Four digits, or all of those before the point.

    >>> _brief(24.8512), _brief(123456.0)
    ('24.85', '123,456')
    """
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"


def _area(points: Sequence[Point]) -> Any:
    counts = sorted(c for p in points if (c := p.numbers["Gaussians"].value))
    median = counts[len(counts) // 2] if counts else 1.0

    def area(point: Point) -> float:
        count = point.numbers["Gaussians"].value
        return min(max(AREA * count / median, SMALLEST), LARGEST) if count else WITHOUT_GAUSSIANS

    return area
