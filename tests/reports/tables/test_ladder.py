from dataclasses import replace

import pytest
from made_up import result, small

from reports.request import Request
from reports.tables import ladder
from reports.tables.table import ReportError
from reports.writers import markdown


def test_a_row_for_each_rung_with_what_it_costs():
    rungs = [replace(small(24 + i, 1 + i), variant=variant) for i, variant in enumerate(ladder.RUNGS)]
    text = markdown.text(ladder.build([*rungs[:3], result("full")], Request()))
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("| A")]
    assert [row[0][:2] for row in rows] == [f"A{i}" for i in range(7)]
    assert [row[2] for row in rows] == ["24.00", "<ins>25.00</ins>", "**26.00**", "–", "–", "–", "–"]
    assert [row[4] for row in rows][:3] == ["50000", "100000", "150000"]


def test_without_a_ladder_there_is_no_block():
    assert ladder.build([result("full")], Request()).blocks == ()


def test_times_of_two_machines_are_not_compared():
    rungs = [replace(small(24 + i), variant=variant) for i, variant in enumerate(("a0_pano_3dgs", "a1_anchors"))]
    with pytest.raises(ReportError, match="differ in machine"):
        ladder.build([rungs[0], replace(rungs[1], machine={"gpu": "H200"})], Request())
