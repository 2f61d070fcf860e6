"""How charts look, and how they are written: SVG whose markers say their numbers when pointed at, and PNG."""

from __future__ import annotations

import html
import io
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import wraps
from textwrap import wrap
from typing import Any, ParamSpec, TypeVar

from pandas import DataFrame

from padgs.reports.charts.palette import GRID, INK, PAPER, dark_rules

P = ParamSpec("P")
T = TypeVar("T")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*")
STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",  # text stays text
    "font.size": 9,
    "font.family": "sans-serif",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": GRID[0],
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "figure.facecolor": PAPER[0],
    "axes.facecolor": "none",
    "text.color": INK[0],
    "axes.labelcolor": INK[0],
    "axes.edgecolor": INK[0],
    "xtick.color": INK[0],
    "ytick.color": INK[0],
    "text.parse_math": False,  # a name with a $ in it is a name
}
DPI = 110
TITLE, SMALL_TITLE = 10.5, 9.0  # points, in figures of up to NARROW inches the second
NARROW = 5.0
LETTERS = 126  # of a point's height that fit into an inch


@dataclass
class Tips:
    """What markers say when pointed at; `add` gives the id that the marker's `gid` must be set to."""

    texts: dict[str, str] = field(default_factory=dict)

    def add(self, text: str) -> str:
        """Keep a text and name it."""
        name = f"tip-{len(self.texts)}"
        self.texts[name] = text
        return name


@dataclass(frozen=True)
class Chart:
    """A finished chart in both formats, with the numbers in it. The SVG turns dark where the reader's screen is."""

    name: str  # file name without extension
    title: str
    svg: str
    png: bytes
    notes: tuple[str, ...] = ()
    numbers: DataFrame | None = None  # None: they are in no file
    narrow: str = ""  # the SVG for the width of a phone; empty where there is none


def styled(draw: Callable[P, T]) -> Callable[P, T]:
    """Let a function that draws use `STYLE`, which matplotlib reads whenever something is added to a figure."""

    @wraps(draw)
    def in_style(*arguments: P.args, **named: P.kwargs) -> T:
        from matplotlib import rc_context

        with rc_context(STYLE):
            return draw(*arguments, **named)

    return in_style


def figure(columns: int, rows: int, width: float = 3.0, height: float = 2.6) -> tuple[Any, Any]:
    """A figure with a grid of axes [rows, columns]; inches per panel."""
    from matplotlib.figure import Figure

    made = Figure(figsize=(columns * width, rows * height), layout="constrained")
    return made, made.subplots(rows, columns, squeeze=False)


def dress(axis: Any, values: Sequence[float], log_from: float = math.inf) -> None:
    """Ticks of an axis for these values: 20k and not 20000; logarithmic where their ratio is at least `log_from`."""
    from matplotlib.ticker import EngFormatter, LogLocator, NullLocator

    known = [value for value in values if math.isfinite(value)]
    if not known:
        return
    if min(known) > 0 and max(known) / min(known) >= log_from:
        getattr(axis.axes, f"set_{axis.axis_name}scale")("log")
        wide = max(known) / min(known) > 30
        axis.set_major_locator(LogLocator(subs=(1.0,) if wide else (1.0, 2.0, 5.0)))
        axis.set_minor_locator(NullLocator())
        axis.set_major_formatter(EngFormatter(sep="") if max(known) >= 1e4 else "{x:g}")
    elif max(known) >= 1e4:
        axis.set_major_formatter(EngFormatter(sep=""))


def lay_out(made: Any, title: str) -> None:
    """Write the title and find the layout, once for all files; what is drawn after this has fixed axes to refer to."""
    size = TITLE if made.get_figwidth() > NARROW else SMALL_TITLE
    letters = int(LETTERS * made.get_figwidth() / size)
    made.suptitle("\n".join(part for line in title.split("\n") for part in wrap(line, letters)), fontsize=size)
    made.draw_without_rendering()
    made.set_layout_engine("none")


def svg(made: Any, name: str, tips: Tips) -> str:
    """A figure as text. The same numbers give the same text; figures of other names or widths share no id with it."""
    from matplotlib import rc_context

    text = io.StringIO()
    with rc_context({"svg.hashsalt": f"padgs {name} {made.get_figwidth():g}"}):
        made.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    return _with_tips(text.getvalue().replace("</style>", f"\n{dark_rules()}</style>", 1), tips)


def png(made: Any) -> bytes:
    """A figure as pixels, on white paper."""
    data = io.BytesIO()
    made.savefig(data, format="png", dpi=DPI, metadata={"Software": None})
    return data.getvalue()


def _with_tips(svg: str, tips: Tips) -> str:
    def said(match: re.Match[str]) -> str:
        return f'<g class="tip"><title>{html.escape(tips.texts[match[1]])}</title>'

    return re.sub(r'<g id="(tip-\d+)">', said, svg)
