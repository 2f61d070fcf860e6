"""The picture of speed, accuracy and stability: what methods reach without stress, in what time, and what they keep."""

from __future__ import annotations

import math
from collections.abc import Sequence

from pandas import DataFrame

from padgs.reports import methods
from padgs.reports.charts import names
from padgs.reports.charts.axis import Axis
from padgs.reports.charts.drawing import Chart, Tips, figure, lay_out, png, styled, svg
from padgs.reports.charts.heat_map import COLORS
from padgs.reports.charts.names import Name
from padgs.reports.charts.palette import INK, weight_of
from padgs.reports.survival import QUALITY, Survivor
from padgs.reports.tables.table import MISSING

AREA = 160.0  # points^2 of a mark
SIZE = (5.6, 4.4)  # inches


@styled
def chart(title: str, survivors: Sequence[Survivor]) -> Chart:
    """Quality at rest over training time, that of the CPU where it is known of all; the stability score as fill, hollow
    where there is none.
    """
    import matplotlib
    from matplotlib.cm import ScalarMappable

    on_cpu = all(one.rest["cpu_seconds"].notna().all() for one in survivors)
    time, words = ("cpu_seconds", "training time on the CPU") if on_cpu else ("train_seconds", "training time")
    found = [(one, one.rest[time].mean(), one.rest[QUALITY].mean()) for one in survivors]
    made, axes = figure(1, 1, *SIZE)
    own, tips, fill = axes[0][0], Tips(), ScalarMappable(cmap=COLORS)
    Axis.of([cost for _, cost, _ in found], True, worse=0).dress(own.xaxis)
    Axis.of([quality for _, _, quality in found]).dress(own.yaxis)
    own.set_xlabel(f"{words} without stress, s ↓")
    own.set_ylabel("WS-PSNR without stress, dB ↑")
    rows = []
    for one, cost, quality in found:
        tip = f"{methods.title(one.preset)}\n{quality:.2f} dB in {cost:.1f} s; score {_said(one.score)}"
        tip += f", worst quartile {_said(one.worst_quartile)}"
        color = "none" if one.score is None else matplotlib.colormaps[COLORS](one.score)
        look = {"s": AREA, "facecolors": [color], "edgecolors": INK[0], "linewidths": 0.8}
        own.scatter(cost, quality, gid=tips.add(tip), zorder=3, **look)
        numbers = {time: cost, "ws_psnr": quality, "score": one.score, "worst_quartile": one.worst_quartile}
        rows.append({"scene": title, "preset": one.preset, **numbers})
    made.colorbar(fill, ax=own, label="stability score: mean of what is kept under stress ↑", aspect=30)
    lay_out(made, f"Speed, accuracy and stability\n{title}")
    radius = math.sqrt(AREA) / 2
    named = [
        Name(
            f"{methods.short(methods.title(one.preset), one.preset)}\n{_said(one.score)}",
            (cost, quality),
            radius,
            weight_of(one.preset, "main"),
        )
        for one, cost, quality in found
    ]
    names.write(own, named, [(cost, quality, radius) for _, cost, quality in found])
    name = f"survival-{survivors[0].place}"
    return Chart(name, title, svg(made, name, tips), png(made), numbers=DataFrame(rows))


def _said(share: float | None) -> str:
    return MISSING if share is None else f"{share:.2f}"
