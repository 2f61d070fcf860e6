"""Charts of smallest models: quality over the Gaussians that are blended, over bytes, and over time per frame."""

from __future__ import annotations

import math
from typing import Any

from pandas import DataFrame

from padgs.reports.charts.axis import set_axis, spans
from padgs.reports.charts.drawing import INK, MARKERS, Chart, color_of, figure, lay_out, show_image, styled, tip
from padgs.reports.conditions import OF_TIMES, footnotes, refuse_mixture
from padgs.reports.frame import by_conditions
from padgs.reports.selection import RunSet
from padgs.reports.smallest import Curve, by_method, curves, searched
from padgs.reports.store import split_image
from padgs.results import SMALLEST_PICTURED, file_name

PANELS = (
    ("blended", "Gaussians blended", 1.0),
    ("bytes", "model, MB", 1e-6),
    ("frame_ms", "minimal ms per frame", 1.0),
)
LOSSES = tuple(f"{loss:g}" for loss in SMALLEST_PICTURED)  # dB, marked in the chart by a ring and a square
LOG_RATIO = 1.5  # largest over smallest size, from which an axis is logarithmic


def charts(run_set: RunSet) -> list[Chart]:
    """Return a chart for each scene with a search for the smallest model, and one of test views if there are renders.

    Raises:
        ReportError: the results of a chart differ in protocol, resolution, length, learning rates, data or machine.
    """
    found = []
    for title, own in by_conditions(searched(run_set), "resolution", "length").items():
        refuse_mixture(own, run_set.request, title, OF_TIMES)
        name = file_name(f"smallest_{own['place'].iloc[0].stem}_{own['resolution'].iloc[0]}_{own['length'].iloc[0]}")
        notes = tuple(footnotes({title: own}, run_set.request.protocol))
        found.append(_chart(name, title, curves(own), notes))
        if rendered := [curve for curve in curves(own) if curve.image is not None]:
            try:
                found.append(_renders(f"{name}_renders", title, rendered, notes))
            except OSError as error:
                run_set.warnings.append(f"a picture is left out: {error}")
    return found


@styled
def _chart(name: str, title: str, found: list[Curve], notes: tuple[str, ...]) -> Chart:
    made, axes = figure(len(PANELS), 1, 3.6, 3.4)
    presets = [curve.preset for curve in found]
    for panel, (quantity, words, unit) in zip(axes.flat, PANELS, strict=True):
        sizes = [v * unit for curve in found for v in curve.values(quantity) if math.isfinite(v)]
        set_axis(panel.xaxis, sizes, spans(sizes, LOG_RATIO))
        for method, seeds in by_method(found).items():
            color = color_of(seeds[0].preset, presets)
            for curve in seeds:
                _draw(panel, curve, quantity, unit, color, first=curve is seeds[0])
            panel.plot([], [], color=color, label=method)
        panel.set_xlabel(words)
    axes[0, 0].set_ylabel("WS-PSNR of test views, dB ↑")
    made.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    what = (
        f"{title}\nsmaller models of the same run; ring: smallest for a loss of {LOSSES[0]} dB, square: {LOSSES[1]} dB"
    )
    what += "; thin: further seeds" if len(found) > len(by_method(found)) else ""
    lay_out(made, what)
    return Chart(name, what, made, notes, _numbers(name, found))


@styled
def _renders(name: str, title: str, found: list[Curve], notes: tuple[str, ...]) -> Chart:
    """Return a test view of each run: ground truth, the whole model, and the smallest models for two losses."""
    made, axes = figure(4, len(found), 3.6, 2.2)
    for row, curve in zip(axes, found, strict=True):
        assert curve.image is not None, "chosen by it"
        steps = [curve.found["steps"][0], *(curve.smallest[loss] for loss in LOSSES)]
        words = [curve.title, f"all: {steps[0]['blended']} Gaussians"]
        words += [f"{loss} dB: {step['blended']}" for loss, step in zip(LOSSES, steps[1:], strict=True)]
        for panel, part, text in zip(row, split_image(curve.image, 4), words, strict=True):
            show_image(panel, part, text)
            panel.set_axis_off()
    what = f"{title}\na test view: ground truth, whole model, and the smallest that lose {' and '.join(LOSSES)} dB"
    lay_out(made, what)
    return Chart(name, what, made, notes)


def _draw(panel: Any, curve: Curve, quantity: str, unit: float, color: str, *, first: bool) -> None:
    """Draw a curve; further seeds of a method are thinner."""
    xs = [value * unit for value in curve.values(quantity)]
    there = sorted((x, y) for x, y in zip(xs, curve.quality, strict=True) if math.isfinite(x) and math.isfinite(y))
    panel.plot(*zip(*there, strict=True), color=color, linewidth=1.2 if first else 0.6)
    for step, x, y in zip(curve.steps, xs, curve.quality, strict=True):
        text = f"{curve.title}\n{step['blended']} Gaussians, {step['bytes'] / 1e6:.2f} MB, {step['frame_ms']:.1f} ms"
        text += f"\n{y:.2f} dB; lost {step['loss']:.2f} dB of validation views"
        panel.plot([x], [y], MARKERS[0], color=color, markersize=4 if first else 2.5, gid=tip(text))
        for loss, around in zip(LOSSES, MARKERS, strict=False):
            if curve.smallest.get(loss) is step:
                panel.plot([x], [y], around, markersize=9, fillstyle="none", color=INK[0], markeredgewidth=1)


def _numbers(name: str, found: list[Curve]) -> DataFrame:
    quantities = ("rows", "blended", "bytes", "frame_ms", "loss", "ws_psnr", "test_ws_psnr", "lpips")
    rows = [
        {"chart": name, "curve": curve.title, "preset": curve.preset, **{q: step[q] for q in quantities}}
        | {"smallest for": " ".join(loss for loss, at in curve.smallest.items() if at is step)}
        for curve in found
        for step in curve.steps
    ]
    return DataFrame(rows, dtype=object)
