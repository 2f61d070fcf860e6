import re

import pytest
from support.made_up import compared, run_set, small, swept

from padgs import baselines
from padgs.reports.charts import drawing, sweep_chart, trade_off_chart
from padgs.reports.charts.drawing import FAMILIES, INK, OTHERS, PAPER, SOFT, color_of, dark_rules
from padgs.reports.methods import method_of


def contrast(one: str, other: str) -> float:
    """Contrast of two colours, as defined by the Web Content Accessibility Guidelines."""

    def luminance(color: str) -> float:
        parts = [int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        red, green, blue = (p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts)
        return 0.2126 * red + 0.7152 * green + 0.0722 * blue

    dark, light = sorted((luminance(one), luminance(other)))
    return (light + 0.05) / (dark + 0.05)


def test_every_method_has_its_own_colour_visible_on_white_and_black(root):
    presets = {*baselines.BUILT_IN, *(path.stem for path in (root / "conf" / "method").glob("*.yaml"))}
    assert {method_of(preset) for preset in presets} <= FAMILIES.keys(), "give new methods a line in FAMILIES"
    for paper, colors in zip(PAPER, zip(*FAMILIES.values(), *OTHERS, strict=True), strict=True):
        assert len(set(colors)) == len(colors) and min(contrast(color, paper) for color in colors) > 2
    assert min(contrast(*pair) for pair in zip(INK, PAPER, strict=True)) > 12
    assert min(contrast(*pair) for pair in zip(SOFT, PAPER, strict=True)) > 4.5


def test_the_colour_of_a_method_does_not_depend_on_others():
    assert color_of("padgs_ray", ["omnigs", "padgs_ray"]) == color_of("padgs", []) != color_of("padgs_plus", [])
    assert color_of("yours", ["mine", "yours"]) != color_of("mine", ["mine", "yours"]) != color_of("padgs", [])


@pytest.fixture(scope="module")
def svgs():
    runs = [*compared(["synthetic-room"], seeds=1)[3:], small(24.0, method="mine", experiments=("all_methods",))]
    runs += swept(values=(0.5, 0.9, 1.0), scenes=["synthetic-room"], seeds=2)
    return [chart.svg for of in (trade_off_chart, sweep_chart) for chart in of.charts(run_set(runs))]


def test_all_colours_are_replaced_on_dark_screens(svgs):
    pairs = (drawing.INK, drawing.SOFT, drawing.GRID, drawing.PAPER)
    known = dict((*FAMILIES.values(), *OTHERS, *pairs))
    for svg in svgs:
        assert dark_rules() in svg
        body = svg.split("</style>", 1)[1]
        assert {found.lower() for found in re.findall(r"(?:fill|stroke): (#\w+)", body)} <= known.keys()


def test_charts_on_one_page_share_no_ids(svgs):
    ids = [set(re.findall(r' id="([a-z]+[0-9a-f]{10})"', svg)) for svg in svgs]
    assert len(ids) == 2 and min(map(len, ids)) > 0
    assert sum(map(len, ids)) == len(set().union(*ids))
