"""Quality over training time, from the logs of runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from padgs.reports import methods
from padgs.reports.charts import names
from padgs.reports.charts.axis import Axis
from padgs.reports.charts.drawing import Chart, Tips, figure, lay_out, png, styled, svg
from padgs.reports.charts.names import Name
from padgs.reports.charts.palette import ALPHA, color_of, weight_of
from padgs.reports.charts.trade_off import TradeOff
from padgs.reports.settings import settings

WIDE, NARROW = (10.6, 4.2), (3.7, 4.2)  # inches
LOOKS: dict[str, dict[str, Any]] = {  # of lines, by the role of their preset
    "main": {"linewidth": 1.3, "zorder": 2.2},
    "variant": {"linewidth": 0.9, "zorder": 2.1},
    "release": {"linewidth": 0.7, "zorder": 2.0, "linestyle": (0, (4, 2))},
}
MARKERS = {-1: "v", 0: "o", 1: "^"}  # of ends, by the side of the axis beyond which they lie
END = 2.5  # points, the radius of the mark where a run ends


@dataclass(frozen=True)
class Curve:
    """The probes of a setting: means over its runs, probe by probe."""

    title: str
    preset: str
    seconds: Sequence[float]
    psnr: Sequence[float]


@styled
def chart(trade_off: TradeOff) -> Chart | None:
    """Held-out PSNR over training seconds, with names where runs end; None where no run left a log.

    A line for each setting, the mean over its seeds and scenes. Quality is shown where the later halves of the runs are
    (`axis.window`), so that beginnings do not squeeze the ends together. Dashed: programs as released.
    """
    curves = _curves(trade_off)
    if not curves:
        return None
    name = trade_off.name.replace("chart_", "time_", 1)
    title = f"{trade_off.title}\nquality over training time, dashed: as released"
    (wide, tips), (narrow, narrow_tips) = (_drawn(trade_off, curves, title, size) for size in (WIDE, NARROW))
    written = svg(wide, name, tips), png(wide), trade_off.notes
    return Chart(name, title, *written, narrow=svg(narrow, name, narrow_tips))


def _curves(trade_off: TradeOff) -> list[Curve]:
    found = []
    for setting in settings(trade_off.runs):
        own = [log for log in setting.runs["log"] if log["psnr"]]
        probes = max((len(log["psnr"]) for log in own), default=0)
        complete = [log for log in own if len(log["psnr"]) == probes]  # a run that was cut short would cut the mean
        if complete:
            seconds, psnr = (np.mean([log[name] for log in complete], 0).tolist() for name in ("seconds", "psnr"))
            found.append(Curve(setting.title, setting.preset, seconds, psnr))
    return found


def _drawn(trade_off: TradeOff, curves: list[Curve], title: str, size: tuple[float, float]) -> tuple[Any, Tips]:
    made, axes = figure(1, 1, *size)
    panel, tips = axes[0, 0], Tips()
    presets = [curve.preset for curve in curves]
    x_axis = Axis.of([s for curve in curves for s in curve.seconds if s > 0], logarithmic=True)
    y_axis = Axis.of([value for curve in curves for value in curve.psnr[len(curve.psnr) // 2 :]], worse=-1)
    x_axis.dress(panel.xaxis)
    y_axis.dress(panel.yaxis)
    wanted, marks, lines = [], [], []
    for curve in curves:
        role, color = trade_off.role(curve.preset), color_of(curve.preset, presets)
        look = {"color": color, "alpha": ALPHA[role]} | LOOKS[role]
        panel.plot(curve.seconds, curve.psnr, **look)
        seconds, psnr = curve.seconds[-1], curve.psnr[-1]
        side, end = y_axis.side(psnr), (seconds, y_axis.position(psnr))
        tip = tips.add(f"{curve.title}\n{psnr:.2f} dB after {seconds:.0f} s")
        look |= {"marker": MARKERS[side], "markersize": 2 * END, "clip_on": False, "gid": tip}
        panel.plot(*end, **look)
        marks.append((*end, END))
        lines.append([(s, value) for s, value in zip(curve.seconds, curve.psnr, strict=True) if s > 0])
        if role != "release" or side:
            text = methods.short(curve.title, curve.preset) + (f"\n{psnr:.1f} dB" if side else "")
            wanted.append(Name(text, end, END, weight_of(curve.preset, role)))
    panel.set_xlabel("training time in seconds, probes not counted")
    panel.set_ylabel("PSNR of a held-out view, dB ↑")
    lay_out(made, title)
    names.write(panel, sorted(wanted, key=lambda name: name.weight == "faint"), marks, lines)
    return made, tips
