import re

import pytest
from made_up import compared, small, swept, write

from padgs import baselines
from padgs.reports import store
from padgs.reports.charts import sweep_chart, trade_off_chart
from padgs.reports.charts.palette import BEYOND, FAMILIES, GRID, INK, OTHERS, PAPER, SOFT, color_of, dark_rules
from padgs.reports.frame import frame
from padgs.reports.gathered import Gathered
from padgs.reports.methods import method_of


def contrast(one: str, other: str) -> float:
    """Of two colours, as the Web Content Accessibility Guidelines define it."""

    def luminance(color: str) -> float:
        parts = [int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        red, green, blue = (p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts)
        return 0.2126 * red + 0.7152 * green + 0.0722 * blue

    dark, light = sorted((luminance(one), luminance(other)))
    return (light + 0.05) / (dark + 0.05)


def test_every_method_has_a_colour_of_its_own_that_is_seen_on_both_papers(root):
    presets = {*baselines.OURS, *(path.stem for path in (root / "conf" / "method").glob("*.yaml"))}
    assert {method_of(preset) for preset in presets} <= FAMILIES.keys(), "give new methods a line in FAMILIES"
    for paper, colors in zip(PAPER, zip(*FAMILIES.values(), *OTHERS, strict=True), strict=True):
        assert len(set(colors)) == len(colors) and min(contrast(color, paper) for color in colors) > 2
    assert min(contrast(*pair) for pair in zip(INK, PAPER, strict=True)) > 12
    assert min(contrast(*pair) for pair in zip(SOFT, PAPER, strict=True)) > 4.5


def test_a_method_has_its_colour_whatever_else_is_there():
    assert color_of("padgs_ray", ["omnigs", "padgs_ray"]) == color_of("padgs", []) != color_of("padgs_plus", [])
    assert color_of("yours", ["mine", "yours"]) != color_of("mine", ["mine", "yours"]) != color_of("padgs", [])


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    runs = [*compared(["synthetic-room"], seeds=1)[3:], small(24.0, method="mine", experiments=("all_methods",))]
    runs += swept(values=(0.5, 0.9, 1.0), scenes=["synthetic-room"], seeds=2)
    logged = Gathered(frame(store.read(write(runs, tmp_path_factory.mktemp("runs")))[0]))
    return [*trade_off_chart.charts(logged), *sweep_chart.charts(logged)]


def test_all_that_is_drawn_for_white_paper_turns_where_the_screen_is_dark(drawn):
    known = dict((*FAMILIES.values(), *OTHERS, INK, SOFT, GRID, BEYOND, PAPER))
    for svg in (svg for chart in drawn for svg in (chart.svg, chart.narrow) if svg):
        assert dark_rules() in svg
        body = svg.split("</style>", 1)[1]
        assert {found.lower() for found in re.findall(r"(?:fill|stroke): (#\w+)", body)} <= known.keys()


def test_pictures_on_one_page_share_no_names_of_things(drawn):
    ids = [set(re.findall(r' id="([a-z]+[0-9a-f]{10})"', svg)) for c in drawn for svg in (c.svg, c.narrow) if svg]
    assert len(ids) == 5 and min(map(len, ids)) > 0
    assert sum(map(len, ids)) == len(set().union(*ids))
