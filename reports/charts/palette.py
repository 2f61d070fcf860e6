"""One colour for each method in every chart, on white paper and on black."""

from __future__ import annotations

from collections.abc import Sequence

from padgs.reports.methods import method_of

# Okabe and Ito's colours first, which colour-blind readers can tell apart; where one is lost on black, a lighter one of
# the same hue stands for it there. Ours are the only pinks, published or plus.
FAMILIES = {  # method -> on white, on black
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
ALPHA = {"main": 0.95, "variant": 0.45, "release": 0.6}  # role -> opacity of its marks
OURS = ("padgs", "padgs_plus")
INK = ("#1d2330", "#e4e8ef")
SOFT = ("#5b6475", "#a3acbc")
GRID = ("#e3e6eb", "#333a46")
BEYOND = ("#f1f3f6", "#20262f")  # behind marks that stand at the margin for what lies beyond it
PAPER = ("#ffffff", "#171b22")

COLORS = tuple(light for light, _ in (*FAMILIES.values(), *OTHERS))


def color_of(preset: str, presets: Sequence[str]) -> str:
    """The colour of a preset's method on white; of methods that nobody foresaw, by their order among `presets`."""
    if method_of(preset) in FAMILIES:
        return FAMILIES[method_of(preset)][0]
    others = [name for name in dict.fromkeys(map(method_of, (*presets, preset))) if name not in FAMILIES]
    return OTHERS[others.index(method_of(preset)) % len(OTHERS)][0]


def weight_of(preset: str, role: str) -> str:
    """How a preset's name is written: bold if it stands for a method of ours, faint if it stands for none."""
    return "faint" if role != "main" else "bold" if method_of(preset) in OURS else "normal"


def dark_rules() -> str:
    """CSS that changes all colours of a picture drawn for white paper, where the reader's screen is dark.

    It looks for the colours as matplotlib writes them; programs that do not know the rules show white paper.
    """
    pairs = dict((*FAMILIES.values(), *OTHERS, INK, SOFT, GRID, BEYOND, PAPER))
    rules = [
        f'[style*="{what}: {light}"]{{{what}:{dark}!important}}'
        for light, dark in pairs.items()
        for what in ("fill", "stroke")
        if light != dark
    ]
    return f"@media (prefers-color-scheme: dark){{{''.join(rules)}}}"
