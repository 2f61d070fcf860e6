from dataclasses import replace
from pathlib import Path

import pytest
from made_up import small

from reports.request import Request
from reports.tables import quirks
from reports.tables.table import ReportError


def runs(**psnr: float):
    return [
        replace(small(value), variant=variant, run=variant, experiments=("quirks",)) for variant, value in psnr.items()
    ]


def test_each_quirk_beside_the_method_as_described():
    table = quirks.build(runs(odgs=25.0, odgs_bias=24.25, odgs_all=22.0, padgs=26.0), Request())
    assert [block.title.partition(",")[0] for block in table.blocks] == ["ODGS", "PaD-GS"]
    change = [column.title for column in table.columns].index("Δ")
    found = {row.title: row.cells[change].value for row in table.blocks[0].rows}
    assert found["as described"] == 0 and found["half a pixel off"] == pytest.approx(-0.75)
    assert found["as released"] == pytest.approx(-3) and found["extent + 100"] is None
    assert quirks.build([small(25)], Request()).blocks == ()


def test_what_was_measured_otherwise_does_not_stand_beside():
    first, second = runs(odgs=25.0, odgs_bias=24.25)
    with pytest.raises(ReportError, match="differ in iterations"):
        quirks.build([first, replace(second, iterations=7)], Request())


def test_every_file_has_a_row(root: Path):
    assert quirks._variants() == {path.stem for path in (root / "conf" / "quirk").glob("*.yaml")}
