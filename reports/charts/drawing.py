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

from reports import methods

P = ParamSpec("P")
T = TypeVar("T")
# Okabe and Ito's colours, which colour-blind readers can tell apart; one for each method, in the order of the tables.
COLORS = ("#E69F00", "#56B4E9", "#009E73", "#D55E00", "#0072B2", "#CC79A7", "#000000", "#8c6d31", "#7f7f7f", "#661100")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*")
MARKER_STEP = 3  # from one preset of a method to the next; no divisor of their number
STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",  # text stays text
    "svg.hashsalt": "padgs",  # the same numbers give the same file
    "font.size": 9,
    "font.family": "sans-serif",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e3e3e3",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "text.parse_math": False,  # a name with a $ in it is a name
}
DPI = 110
LETTERS_PER_INCH = 12  # of a title


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
    """A finished chart in both formats, with the numbers in it."""

    name: str  # file name without extension
    title: str
    svg: str
    png: bytes
    notes: tuple[str, ...] = ()
    numbers: DataFrame | None = None  # None: they are in no file


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


def finish(
    made: Any, name: str, title: str, tips: Tips, notes: tuple[str, ...], numbers: DataFrame | None = None
) -> Chart:
    """Title and files of a figure."""
    width = int(LETTERS_PER_INCH * made.get_figwidth())
    made.suptitle("\n".join(part for line in title.split("\n") for part in wrap(line, width)), fontsize=10.5)
    made.draw_without_rendering()
    made.set_layout_engine("none")  # the layout is found; each file would find it again
    svg, png = io.StringIO(), io.BytesIO()
    made.savefig(svg, format="svg", metadata={"Date": None, "Creator": None})
    made.savefig(png, format="png", dpi=DPI, metadata={"Software": None})
    return Chart(name, title, _with_tips(svg.getvalue(), tips), png.getvalue(), notes, numbers)


def color_of(preset: str, presets: Sequence[str]) -> str:
    """The colour of a preset's method: the paper's always have the same."""
    known = list(methods.TITLES)
    others = [name for name in dict.fromkeys(map(methods.method_of, presets)) if name not in known]
    return COLORS[[*known, *others].index(methods.method_of(preset)) % len(COLORS)]


def marker_of(preset: str, presets: Sequence[str]) -> str:
    """The shape of a preset: presets of one method have its colour and differ in shape."""
    method = methods.method_of(preset)
    known = [*methods.TITLES, *(name for name in map(methods.method_of, presets) if name not in methods.TITLES)]
    own = [name for name in methods.ordered([preset, *presets]) if methods.method_of(name) == method]
    return MARKERS[(known.index(method) + MARKER_STEP * own.index(preset)) % len(MARKERS)]


def _with_tips(svg: str, tips: Tips) -> str:
    def said(match: re.Match[str]) -> str:
        return f'<g class="tip"><title>{html.escape(tips.texts[match[1]])}</title>'

    return re.sub(r'<g id="(tip-\d+)">', said, svg)
