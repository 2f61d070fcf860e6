"""The stages as stacked bars, each beside the least time that this machine could take for it."""

from __future__ import annotations

from io import BytesIO
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = {
    "target": "#d9d9d9",
    "decode": "#2166ac",
    "project": "#1b9e77",
    "sort": "#e6ab02",
    "blend": "#d6604d",
    "draw": "#bdbdbd",
    "loss": "#8073ac",
    "blend_backward": "#f4a582",
    "project_backward": "#8fd3bf",
    "decode_backward": "#92c5de",
    "backward": "#a6a6a6",
    "observe": "#8c6d31",
    "optimiser": "#a6611a",
    "adapt": "#dfc27d",
    "rest": "#7f7f7f",
}
TEXT = {"decode": "white", "loss": "white", "optimiser": "white", "observe": "white"}
LABEL_SHARE = 0.05  # of the longest bar, from which a segment has room for its own name


def stacked_bars(report: dict[str, Any]) -> bytes:
    """A PNG with one panel for each size of a report: CPU time of the stages, measured and at the ceilings."""
    from matplotlib.figure import Figure

    sizes = report["sizes"]
    figure = Figure(figsize=(12, 1.9 + 1.9 * len(sizes)), layout="constrained")
    panels = figure.subplots(len(sizes), 1, squeeze=False)[:, 0]
    for panel, size in zip(panels, sizes.values(), strict=True):
        _panel(panel, size)
    machine = report["machine"]
    noisy = "   NOISY: not for publication" if report["noisy"] else ""
    figure.suptitle(
        f"One PaD-GS training iteration: {machine['cpu']}, {machine['threads']} threads, {machine['isa']}{noisy}",
        fontsize=11,
    )
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=8, fontsize=8, frameon=False)
    out = BytesIO()
    figure.savefig(out, format="png", dpi=130)
    return out.getvalue()


def _panel(axes: Axes, size: dict[str, Any]) -> None:
    stages = size["stages"]
    rows = {
        "measured": {name: timing["cpu"]["min"] * 1e3 for name, timing in stages.items()},
        "floor": {name: timing.get("floor", 0.0) * 1e3 for name, timing in stages.items()},
    }
    longest = sum(rows["measured"].values())
    for row, lengths in enumerate(rows.values()):
        left = 0.0
        for name, length in lengths.items():
            label = name.replace("_", " ") if row == 0 else None
            axes.barh(row, length, left=left, color=COLOURS[name], edgecolor="white", linewidth=0.6, label=label)
            if length > LABEL_SHARE * longest:
                words = name.replace("_backward", "\nbackward").replace("_", " ")
                text = f"{words}\n{_milliseconds(length)}"
                axes.text(left + length / 2, row, text, ha="center", va="center", fontsize=7.5, color=TEXT.get(name))
            left += length
        axes.text(left, row, f"  {_milliseconds(left)}", va="center", fontsize=9)
    axes.set_yticks(range(len(rows)), list(rows))
    axes.set_ylim(1.5, -0.5)  # the first row on top
    axes.set_xlim(0, longest * 1.08)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(axis="y", length=0)
    wall = size["iteration"]["wall"]["median"] * 1e3
    axes.set_title(
        f"{size['width']}x{size['height']}, {size['counters']['gaussians']:,} Gaussians; "
        f"the iteration takes {_milliseconds(wall)} ms by the wall clock",
        loc="left",
        fontsize=10,
    )
    axes.set_xlabel("CPU time of all threads, ms (least of the repeats)", fontsize=9)


def _milliseconds(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"
