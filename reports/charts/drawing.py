"""The style of charts, one colour per method on white and on black, and the formats PNG and SVG."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, wraps
from textwrap import wrap
from typing import Any, ParamSpec, TypeVar

from pandas import DataFrame

from padgs.reports.methods import method_of

P = ParamSpec("P")
T = TypeVar("T")
# Pairs of colours: on white, and on black where readers have a dark screen. The first five are Okabe and Ito's, which
# colour-blind readers can tell apart. Only PaD-GS and padgs+ are pink.
FAMILIES = {
    "egonerf": ("#e69f00", "#e69f00"),
    "op43dgs": ("#56b4e9", "#7cc8f2"),
    "odgs": ("#009e73", "#1fb98c"),
    "omnigs": ("#d55e00", "#ee7d2b"),
    "spags": ("#0072b2", "#3f92e0"),
    "padgs": ("#cc79a7", "#e08fbd"),
    "padgs_plus": ("#b0005e", "#ff4fa3"),
    "cubemap_3dgs": ("#333333", "#d5d9e0"),
    "crops_3dgs": ("#8c6d31", "#c2a05c"),
    "sc_omnigs": ("#7f7f7f", "#9aa0aa"),
    "seam360gs": ("#332288", "#9d92ee"),
}
OTHERS = (("#44aa99", "#44aa99"), ("#999933", "#b3b34a"), ("#882255", "#cc6f9c"))
INK = ("#1d2330", "#e4e8ef")
SOFT = ("#5b6475", "#a3acbc")
GRID = ("#e3e6eb", "#333a46")
PAPER = ("#ffffff", "#171b22")
COLORS = tuple(light for light, _ in (*FAMILIES.values(), *OTHERS))
ALPHA = {"main": 0.95, "variant": 0.45, "release": 0.6}  # role of a preset -> opacity of its marks
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*")
IMAGE_WIDTH = 512  # maximum pixels of an image in a chart
DPI = 110
TITLE_SIZE, SMALL_TITLE_SIZE, NARROW = 10.5, 9.0, 5.0  # points; the small one in figures of up to NARROW inches
LETTERS = 126  # letters per inch at a font size of one point
TIP = "tip:"  # prefix of a gid that holds a tooltip
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
    **dict.fromkeys(("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color"), INK[0]),
    "text.parse_math": False,  # a $ in a name is a $
}


@dataclass(frozen=True)
class Chart:
    """A drawn figure, its notes, and its numbers for a CSV file."""

    name: str  # file name without extension
    title: str
    figure: Any
    notes: tuple[str, ...] = ()
    numbers: DataFrame | None = None

    @cached_property
    def png(self) -> bytes:
        """The figure on white paper."""
        data = io.BytesIO()
        self.figure.savefig(data, format="png", dpi=DPI, metadata={"Software": None})
        return data.getvalue()

    @cached_property
    def svg(self) -> str:
        """The figure with tooltips, dark on dark screens; equal charts give equal text, others share no id with it."""
        from matplotlib import rc_context

        text = io.StringIO()
        with rc_context({**STYLE, "svg.hashsalt": f"padgs {self.name}"}):
            self.figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
        dark = text.getvalue().replace("</style>", f"\n{dark_rules()}</style>", 1)
        return re.sub(rf'<g id="{TIP}([^"]*)">', r'<g class="tip"><title>\1</title>', dark)


def tip(text: str) -> str:
    """Return the `gid` of an artist that shows a tooltip in SVG files."""
    return TIP + text


def styled(draw: Callable[P, T]) -> Callable[P, T]:
    """Run a drawing function with `STYLE`, which matplotlib reads whenever something is added to a figure."""

    @wraps(draw)
    def in_style(*arguments: P.args, **named: P.kwargs) -> T:
        from matplotlib import rc_context

        with rc_context(STYLE):
            return draw(*arguments, **named)

    return in_style


def figure(columns: int, rows: int, width: float = 3.0, height: float = 2.6) -> tuple[Any, Any]:
    """Return a figure with axes [rows, columns] of this size in inches."""
    from matplotlib.figure import Figure

    made = Figure(figsize=(columns * width, rows * height), layout="constrained")
    return made, made.subplots(rows, columns, squeeze=False)


def lay_out(made: Any, title: str) -> None:
    """Write the title and fix the layout, so that later additions can refer to positions in the figure."""
    size = TITLE_SIZE if made.get_figwidth() > NARROW else SMALL_TITLE_SIZE
    letters = int(LETTERS * made.get_figwidth() / size)
    made.suptitle("\n".join(part for line in title.split("\n") for part in wrap(line, letters)), fontsize=size)
    made.draw_without_rendering()
    made.set_layout_engine("none")


def show_image(panel: Any, image: Any, title: str) -> None:
    """Show an image of at most `IMAGE_WIDTH` pixels with a title."""
    image.thumbnail((IMAGE_WIDTH, IMAGE_WIDTH))
    panel.imshow(image)
    panel.set_title(title)


def color_of(preset: str, presets: Sequence[str]) -> str:
    """Return the colour of a preset's method on white; methods without one get theirs by their order in `presets`."""
    if method_of(preset) in FAMILIES:
        return FAMILIES[method_of(preset)][0]
    others = [name for name in dict.fromkeys(map(method_of, (*presets, preset))) if name not in FAMILIES]
    return OTHERS[others.index(method_of(preset)) % len(OTHERS)][0]


def dark_rules() -> str:
    """Return CSS that replaces all colours on dark screens; programs that ignore the rules show white paper."""
    pairs = dict((*FAMILIES.values(), *OTHERS, INK, SOFT, GRID, PAPER))
    rules = [
        f'[style*="{what}: {light}"]{{{what}:{dark}!important}}'
        for light, dark in pairs.items()
        for what in ("fill", "stroke")
        if light != dark
    ]
    return f"@media (prefers-color-scheme: dark){{{''.join(rules)}}}"
