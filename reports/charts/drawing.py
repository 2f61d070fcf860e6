"""Style, axes and labels of charts, one colour per method, and the formats PNG and SVG."""

import io
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from textwrap import wrap
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pandas import DataFrame
from PIL import Image

from padgs.reports.methods import METHODS, color, method_of

OTHERS = ("#44aa99", "#999933", "#882255")
INK, SOFT, GRID, PAPER = "#1d2330", "#5b6475", "#e3e6eb", "#ffffff"
COLORS = (*(method["color"] for method in METHODS.values()), *OTHERS)
ALPHA = {"main": 0.95, "variant": 0.45, "release": 0.6}  # role of a preset -> opacity of its marks
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*")
DPI = 110
TITLE_SIZE, SMALL_TITLE_SIZE, NARROW = 10.5, 9.0, 5.0  # points; the small one in figures of up to NARROW inches
LETTERS = 126  # letters per inch at a font size of one point
STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",  # text stays text
    "font.size": 9,
    "font.family": "sans-serif",
    **dict.fromkeys(("axes.spines.top", "axes.spines.right", "legend.frameon"), False),
    **dict.fromkeys(("axes.grid", "axes.axisbelow"), True),
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "figure.facecolor": PAPER,
    "axes.facecolor": "none",
    **dict.fromkeys(("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color"), INK),
    "text.parse_math": False,  # a $ in a name is a $
}
FENCE = 1.5  # interquartile ranges
PAD = 0.1  # share of the shown range that is free at both ends of an axis
SINGLE = {False: 1.0, True: 0.5}  # range around a single value: one unit, or half a decade of a logarithmic axis
GAPS = (2.0, 5.0, 9.0, 14.0, 20.0, 28.0, 38.0, 50.0, 65.0, 85.0, 110.0, 140.0, 180.0)  # pixels from the mark's edge
DIRECTIONS = 24
BESIDE = 7.0  # pixels between a mark and its label; a label further away has a leader line
CLEARANCE = 1.5  # pixels around a label
ON_A_MARK = 0.8  # cost of a covered square pixel of a mark, in pixels of distance
OURS = ("padgs", "padgs_plus")  # methods with bold labels
FONT_SIZES = {"bold": 9.0, "normal": 8.5, "faint": 7.0}  # points, by weight


@dataclass(frozen=True)
class Label:
    """The text of a mark at a point in data coordinates, with the radius of the mark in points."""

    text: str
    at: tuple[float, float]
    radius: float
    weight: str  # key of `FONT_SIZES`
    color: str | None = None  # None: as all text


@dataclass(frozen=True)
class Chart:
    """A drawn figure or image, its notes, and its numbers for a CSV file."""

    name: str  # file name without extension
    title: str
    figure: Any
    notes: tuple[str, ...] = ()
    numbers: DataFrame | None = None

    @cached_property
    def png(self) -> bytes:
        """The figure on white paper."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        data = io.BytesIO()
        if isinstance(self.figure, Image.Image):
            self.figure.save(data, "PNG")
            return data.getvalue()
        self.figure.set_dpi(DPI)
        FigureCanvasAgg(self.figure).print_png(data, metadata={"Software": None})  # `savefig` would draw it twice
        return data.getvalue()

    @cached_property
    def svg(self) -> str:
        """The figure with text as text; equal charts give equal files."""
        from matplotlib import rc_context

        text = io.StringIO()
        with rc_context({**STYLE, "svg.hashsalt": f"padgs {self.name}"}):
            self.figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
        return text.getvalue()


@contextmanager
def styled() -> Iterator[None]:
    """Draw with `STYLE`, which matplotlib reads whenever something is added to a figure; a decorator."""
    from matplotlib import rc_context

    with rc_context(STYLE):
        yield


def figure(columns: int, rows: int, width: float = 3.0, height: float = 2.6) -> tuple[Any, Any]:
    """Return a figure with axes [rows, columns] of this size in inches."""
    from matplotlib.figure import Figure

    made = Figure(figsize=(columns * width, rows * height), layout="constrained")
    return made, made.subplots(rows, columns, squeeze=False)


def lay_out(made: Any, title: str) -> None:
    """Write the title and fix the layout, so that later additions can refer to positions in the figure."""
    size = TITLE_SIZE if made.get_figwidth() > NARROW else SMALL_TITLE_SIZE
    made.suptitle(wrap_title(title, int(LETTERS * made.get_figwidth() / size)), fontsize=size)
    made.get_layout_engine().execute(made)
    made.set_layout_engine("none")


def wrap_title(title: str, letters: int) -> str:
    """Return a title in lines of at most so many letters."""
    return "\n".join(part for line in title.split("\n") for part in wrap(line, letters))


def color_of(preset: str, presets: Sequence[str]) -> str:
    """Return the colour of a preset's method; methods without one get theirs by their order in `presets`."""
    if own := color(method_of(preset)):
        return own
    others = [name for name in dict.fromkeys(map(method_of, (*presets, preset))) if not color(name)]
    return OTHERS[others.index(method_of(preset)) % len(OTHERS)]


def window(values: Sequence[float], worse: int) -> tuple[float, float]:
    """Return the smallest and largest value that is no outlier at the worse end (-1 low, 1 high, 0 neither).

    An outlier lies more than 1.5 interquartile ranges beyond the quartile (Tukey, Exploratory Data Analysis, 1977).
    At most a quarter of the values are outliers, and the best value never is. Pass logarithms for logarithmic axes.

    >>> window([19.8, 27.4, 27.8, 29.0, 30.0, 31.5], worse=-1), window([20.0, 30.0], worse=-1)
    ((27.4, 31.5), (20.0, 30.0))
    """
    first, third = np.quantile(values, [0.25, 0.75])
    reach = FENCE * (third - first)
    low, high = (first - reach if worse < 0 else -math.inf), (third + reach if worse > 0 else math.inf)
    kept = [value for value in values if low <= value <= high]
    return min(kept), max(kept)


def spans(values: Sequence[float], ratio: float) -> bool:
    """Return whether all values are positive and the largest is at least `ratio` times the smallest."""
    return bool(values) and min(values) > 0 and max(values) / min(values) >= ratio


def set_axis(axis: Any, values: Sequence[float], logarithmic: bool = False, worse: int = 0) -> tuple[float, float]:
    """Set limits, scale and ticks of an axis for values, above 0 if logarithmic; return the limits; see `window`."""
    from matplotlib.ticker import EngFormatter, LogLocator, MaxNLocator, NullLocator

    values = [value for value in values if math.isfinite(value)] or [1.0]  # inf: the PSNR of an exact render
    scaled = [math.log10(value) if logarithmic else value for value in values]
    low, high = window(scaled, worse)
    if high == low:
        low, high = low - SINGLE[logarithmic] / 2, high + SINGLE[logarithmic] / 2
    pad = PAD * (high - low)
    low, high = (end([v for v in (low, high, *scaled) if low - pad <= v <= high + pad]) for end in (min, max))
    ends = (10 ** (low - pad), 10 ** (high + pad)) if logarithmic else (low - pad, high + pad)
    name = axis.axis_name
    axis.axes.set(**{f"{name}scale": "log" if logarithmic else "linear", f"{name}lim": ends})
    decades = logarithmic and ends[1] >= 3 * ends[0]
    subs = (1.0, 2.0, 5.0) if ends[1] >= 10 * ends[0] else (1.0, 2.0, 3.0, 5.0, 7.0)
    axis.set_major_locator(LogLocator(subs=subs) if decades else MaxNLocator(6, steps=[1, 2, 5, 10]))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(EngFormatter(sep="") if ends[1] >= 1e4 else "{x:g}")
    return ends


def write_labels(panel: Any, labels: Sequence[Label], marks: Sequence[tuple[float, float, float]]) -> list[Any]:
    """Write labels one after the other, each at its cheapest place, and return the texts that found one.

    Positions are fractions of the figure, so its layout must be fixed, and all file formats agree. `panel`: matplotlib
    axes; `labels`: the important ones first; `marks`: x, y (data) and radius (points), with and without a label.
    """
    figure, points = panel.figure, panel.figure.dpi / 72
    to_pixels, to_figure = panel.transData.transform, figure.transFigure.inverted().transform
    discs = np.array([(*to_pixels((x, y)), radius * points) for x, y, radius in marks]).reshape(-1, 3)
    squares = np.concatenate([discs[:, :2] - discs[:, 2:], discs[:, :2] + discs[:, 2:]], 1)
    inside = panel.get_window_extent().padded(-CLEARANCE)
    taken, written = np.zeros((0, 4)), []
    for label in labels:
        soft = label.weight == "faint"
        text = figure.text(0.5, 0.5, label.text, fontsize=FONT_SIZES[label.weight])
        text.set_color(label.color or (SOFT if soft else INK))
        text.set(ha="center", va="center", linespacing=1.05, zorder=6, weight="normal" if soft else label.weight)
        extent, at, radius = text.get_window_extent(), to_pixels(label.at), label.radius * points
        boxes, costs = _candidates(at, radius, np.array([extent.width, extent.height]))
        free = (boxes[:, :2] >= inside.min).all(1) & (boxes[:, 2:] <= inside.max).all(1)
        free &= ~_overlap(boxes, taken).any(1)
        if not free.any():
            text.remove()
            continue
        boxes, costs = boxes[free], costs[free]
        box = boxes[np.argmin(costs + ON_A_MARK * _overlap(boxes, squares).sum(1))]
        taken = np.concatenate([taken, [box + np.array([-1, -1, 1, 1]) * CLEARANCE]])
        text.set_position(to_figure(box.reshape(2, 2).mean(0)))
        end = np.clip(at, box[:2], box[2:])
        if (distance := np.linalg.norm(end - at)) - radius > BESIDE:
            leader = np.stack([at + (end - at) * radius / distance, end])
            panel.plot(*panel.transData.inverted().transform(leader).T, color=SOFT, linewidth=0.5, zorder=1.6)
        written.append(text)
    return written


def weight_of(preset: str, role: str) -> str:
    """Return the font weight of a preset's label: bold for main presets of ours, faint for variants and releases."""
    return "faint" if role != "main" else "bold" if method_of(preset) in OURS else "normal"


def _candidates(at: NDArray, radius: float, size: NDArray) -> tuple[NDArray, NDArray]:
    """Return boxes [n, 4] (left, bottom, right, top) around a mark, and costs [n]: best near and to the upper right."""
    gaps, angles = np.repeat(GAPS, DIRECTIONS), np.tile(np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS), len(GAPS))
    direction = np.stack([np.cos(angles), np.sin(angles)], 1)
    # The middle of a box that moves around the disc of the mark without touching it.
    middles = at + (radius + gaps)[:, None] * direction + size / 2 * np.clip(1.5 * direction, -1, 1)
    return np.concatenate([middles - size / 2, middles + size / 2], 1), gaps + 2 * (2 - direction.sum(1))


def _overlap(boxes: NDArray, others: NDArray) -> NDArray:
    """Return the areas [n, m] that boxes [n, 4] share with others [m, 4]."""
    shared = np.minimum(boxes[:, None, 2:], others[:, 2:]) - np.maximum(boxes[:, None, :2], others[:, :2])
    return np.clip(shared, 0, None).prod(2)
