"""Quality over training time, from the logs of runs."""

from __future__ import annotations

from typing import Any

import numpy as np

from padgs.reports import methods
from padgs.reports.charts.axis import Axis
from padgs.reports.charts.drawing import ALPHA, Chart, color_of, figure, lay_out, styled, tip
from padgs.reports.charts.labels import Label, weight_of, write_labels
from padgs.reports.charts.trade_off import TradeOff
from padgs.reports.selection import Setting, settings

SIZE = (10.6, 4.2)  # inches
LOOKS: dict[str, dict[str, Any]] = {  # role of a preset -> look of its line
    "main": {"linewidth": 1.3, "zorder": 2.2},
    "variant": {"linewidth": 0.9, "zorder": 2.1},
    "release": {"linewidth": 0.7, "zorder": 2.0, "linestyle": (0, (4, 2))},
}
MARKERS = {-1: "v", 0: "o", 1: "^"}  # end of the axis that the last point lies beyond -> its marker
RADIUS = 2.5  # points, of the mark at the end of a run


@styled
def chart(trade_off: TradeOff) -> Chart | None:
    """Return held-out PSNR over training seconds, with a label where a run ends; None if no run has a log.

    The axis of quality shows the range of the later halves of the runs (`axis.window`). Releases are dashed.
    """
    curves = _curves(trade_off)
    if not curves:
        return None
    made, axes = figure(1, 1, *SIZE)
    panel, presets = axes[0, 0], [setting.preset for setting, _, _ in curves]
    x_axis = Axis.of([s for _, seconds, _ in curves for s in seconds if s > 0], logarithmic=True)
    y_axis = Axis.of([value for _, _, psnr in curves for value in psnr[len(psnr) // 2 :]], worse=-1)
    x_axis.apply(panel.xaxis)
    y_axis.apply(panel.yaxis)
    labels, marks, lines = [], [], []
    for setting, seconds, psnr in curves:
        title, preset, role = setting.title, setting.preset, trade_off.role(setting.preset)
        look = {"color": color_of(preset, presets), "alpha": ALPHA[role]} | LOOKS[role]
        panel.plot(seconds, psnr, **look)
        side, end = y_axis.side(psnr[-1]), (seconds[-1], y_axis.position(psnr[-1]))
        gid = tip(f"{title}\n{psnr[-1]:.2f} dB after {seconds[-1]:.0f} s")
        panel.plot(*end, **look, marker=MARKERS[side], markersize=2 * RADIUS, clip_on=False, gid=gid)
        marks.append((*end, RADIUS))
        lines.append([(s, value) for s, value in zip(seconds, psnr, strict=True) if s > 0])
        if role != "release" or side:
            text = methods.short(title, preset) + (f"\n{psnr[-1]:.1f} dB" if side else "")
            labels.append(Label(text, end, RADIUS, weight_of(preset, role)))
    panel.set_xlabel("training time in seconds, evaluations not counted")
    panel.set_ylabel("PSNR of a held-out view, dB ↑")
    title = f"{trade_off.title}\nquality over training time, dashed: as released"
    lay_out(made, title)
    write_labels(panel, sorted(labels, key=lambda label: label.weight == "faint"), marks, lines)
    return Chart(trade_off.name.replace("chart_", "time_", 1), title, made, trade_off.notes)


def _curves(trade_off: TradeOff) -> list[tuple[Setting, list[float], list[float]]]:
    """Return seconds and PSNR of each setting, evaluation by evaluation, as means over its runs with a complete log."""
    found = []
    for setting in settings(trade_off.runs):
        logs = [log for log in setting.runs["log"] if log["psnr"]]
        count = max((len(log["psnr"]) for log in logs), default=0)
        complete = [log for log in logs if len(log["psnr"]) == count]  # a run that was cut short would cut the mean
        if complete:
            seconds, psnr = (np.mean([log[name] for log in complete], 0).tolist() for name in ("seconds", "psnr"))
            found.append((setting, seconds, psnr))
    return found
