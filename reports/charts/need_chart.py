"""The picture of a need: quality over the Gaussians that are blended, over bytes, and over time per frame."""

from __future__ import annotations

import math
from typing import Any

from pandas import DataFrame

from padgs.reports.charts.drawing import MARKERS, Chart, Tips, dress, figure, lay_out, png, styled, svg
from padgs.reports.charts.palette import INK, color_of
from padgs.reports.conditions import OF_TIMES, footnotes, refuse_mixture
from padgs.reports.frame import by_conditions
from padgs.reports.gathered import Gathered
from padgs.reports.needs import Curve, by_method, curves, searched
from padgs.reports.pictures import split
from padgs.results import NEED_PICTURED, file_name

PANELS = (
    ("blended", "Gaussians blended", 1.0),
    ("bytes", "model, MB", 1e-6),
    ("frame_ms", "ms of a frame, the least", 1.0),
)
PICTURED = tuple(f"{loss:g}" for loss in NEED_PICTURED)  # dB
AROUND = MARKERS[: len(PICTURED)]  # a ring and a square, about what is needed
WIDTH = 512  # pixels of a picture at most
DOUBLINGS = 1.5  # ratio from which on sizes stand on a logarithmic axis


def charts(gathered: Gathered) -> list[Chart]:
    """A picture of each scene that something was searched on.

    Raises:
        ReportError: results that must not stand together.
    """
    found = []
    for title, own in by_conditions(searched(gathered), "resolution", "length").items():
        refuse_mixture(own, gathered.request, title, OF_TIMES)
        name = file_name(f"need_{own['place'].iloc[0].stem}_{own['resolution'].iloc[0]}_{own['length'].iloc[0]}")
        notes = footnotes({title: own}, gathered.request.protocol)
        found.append(_chart(name, title, own, notes))
        if pictured := [curve for curve in curves(own) if curve.picture is not None]:
            found.append(_pictures(f"{name}_pictures", title, pictured, notes))
    return found


@styled
def _chart(name: str, title: str, runs: DataFrame, notes: list[str]) -> Chart:
    found = curves(runs)
    made, axes = figure(len(PANELS), 1, 3.6, 3.4)
    tips = Tips()
    for panel, (quantity, words, unit) in zip(axes.flat, PANELS, strict=True):
        for method, seeds in by_method(found).items():
            for curve in seeds:
                _draw(panel, curve, quantity, unit, tips, [one.preset for one in found], first=curve is seeds[0])
            panel.plot([], [], color=color_of(seeds[0].preset, [one.preset for one in found]), label=method)
        dress(panel.xaxis, [v * unit for one in found for v in one.values(quantity)], log_from=DOUBLINGS)
        panel.set_xlabel(words)
    axes[0, 0].set_ylabel("WS-PSNR of test views, dB ↑")
    made.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    rings = f"in a ring what is needed for {PICTURED[0]} dB, in a square for {PICTURED[1]} dB"
    what = f"{title}\nsmaller models of the same run; {rings}"
    if len(found) > len(by_method(found)):
        what += "; thin: further seeds"
    lay_out(made, what)
    return Chart(name, what, svg(made, name, tips), png(made), tuple(notes), _numbers(name, found))


@styled
def _pictures(name: str, title: str, found: list[Curve], notes: list[str]) -> Chart:
    """A test view of each run: as photographed, of the whole model, and of the smallest for two losses."""
    made, axes = figure(4, len(found), 3.6, 2.2)
    for row, curve in zip(axes, found, strict=True):
        assert curve.picture is not None, "chosen by it"
        parts = split(curve.picture, 4)
        whole, steps = curve.found["steps"][0], [curve.needs[epsilon] for epsilon in PICTURED]
        words = [curve.title, f"all: {whole['blended']} Gaussians"]
        words += [f"{epsilon} dB: {step['blended']}" for epsilon, step in zip(PICTURED, steps, strict=True)]
        for panel, part, text in zip(row, parts, words, strict=True):
            part.thumbnail((WIDTH, WIDTH))
            panel.imshow(part)
            panel.set_title(text)
            panel.set_axis_off()
    what = f"{title}\na test view: photograph, whole model, and the smallest that lose {' and '.join(PICTURED)} dB"
    lay_out(made, what)
    return Chart(name, what, svg(made, name, Tips()), png(made), tuple(notes))


def _draw(panel: Any, curve: Curve, quantity: str, unit: float, tips: Tips, presets: list[str], *, first: bool) -> None:
    """A curve; further seeds of a method are thinner, and say nothing."""
    color = color_of(curve.preset, presets)
    xs = [value * unit for value in curve.values(quantity)]
    there = sorted((x, y) for x, y in zip(xs, curve.quality, strict=True) if math.isfinite(x) and math.isfinite(y))
    panel.plot(*zip(*there, strict=True), color=color, linewidth=1.2 if first else 0.6)
    for step, x, y in zip(curve.steps, xs, curve.quality, strict=True):
        text = f"{curve.title}\n{step['blended']} Gaussians, {step['bytes'] / 1e6:.2f} MB, {step['frame_ms']:.1f} ms"
        text += f"\n{y:.2f} dB; lost {step['loss']:.2f} dB of calibration views"
        panel.plot([x], [y], MARKERS[0], color=color, markersize=4 if first else 2.5, gid=tips.add(text))
        for epsilon, around in zip(PICTURED, AROUND, strict=True):
            if curve.needs.get(epsilon) is step:
                panel.plot([x], [y], around, markersize=9, fillstyle="none", color=INK[0], markeredgewidth=1)


def _numbers(name: str, found: list[Curve]) -> DataFrame:
    quantities = ("rows", "blended", "bytes", "frame_ms", "loss", "ws_psnr", "test_ws_psnr", "lpips")
    rows = [
        {"chart": name, "curve": curve.title, "preset": curve.preset, **{q: step[q] for q in quantities}}
        | {"needed for": " ".join(epsilon for epsilon, at in curve.needs.items() if at is step)}
        for curve in found
        for step in curve.steps
    ]
    return DataFrame(rows, dtype=object)
