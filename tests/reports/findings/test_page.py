from itertools import product

import pytest
from made_up import gathered, of_experiment

from padgs.reports import published
from padgs.reports.findings.claims import CLAIMS
from padgs.reports.findings.judging import in_the_paper, judge
from padgs.reports.findings.page import findings


def rows(page) -> list[list[str]]:
    lines = [line for line in page.text.splitlines() if line.startswith("| ")][2:]
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]


@pytest.fixture(scope="module")
def crossed():
    """`modulation` where opacity modulation costs 2 dB and the paper's voxel gains as much."""
    made = product((("padgs", 2.0), ("padgs_small", 0.0)), ((0.9, -2.0), (0.0, 0.0)), ((0, 0.0), (1, 0.1)))
    return gathered(
        [
            of_experiment("modulation@cpu", 25 + voxel + loss + off, preset=preset, options={"tau": tau}, seed=seed)
            for (preset, voxel), (tau, loss), (seed, off) in made
        ]
    )


def test_every_claim_has_a_row_with_what_to_run(crossed):
    empty = rows(findings(gathered([])))
    assert len(empty) == len(CLAIMS) and len({row[0] for row in empty}) == len(CLAIMS)
    assert {row[3] for row in empty} == {"**not measured yet**", "**not testable here**"}
    assert all(row[5] for row in empty)
    known = {claim.text for claim in CLAIMS if judge(claim, crossed).lines}
    assert {row[0].rpartition(" (")[0] for row in rows(findings(crossed)) if row[2] != "–"} == known


def test_verdict_number_reason_and_command_stand_together(crossed):
    page = findings(crossed)
    (row,) = (row for row in rows(page) if row[0].startswith("Opacity modulation (τ = 0.9)"))
    assert row[2].count("-2.00 ± 0.00") == 2 and row[3] == "**does not hold**" and "see" in row[4]
    assert row[5] == "`modulation@cpu`"
    assert (
        "- `modulation@cpu`: `padgs-run +experiment=modulation scale=cpu seed=0,1 train.iterations=1500 "
        "data.generator.width=512`" in page.text
    )
    assert "- `tau`: `padgs-run +sweep=tau`; not run." in page.text


def test_a_reason_is_shown_with_its_verdict_only(crossed):
    for claim, row in zip(CLAIMS, rows(findings(crossed)), strict=True):
        others = [reason for verdict, reason in claim.reasons.items() if verdict is not judge(claim, crossed).verdict]
        assert row[4] not in others


def test_every_number_of_the_paper_that_a_claim_names_is_there():
    for claim in CLAIMS:
        found = in_the_paper(claim, published.load())
        missing = [scene for scene in claim.published if "op43dgs" in claim.others.published and scene[1] == "ricoh360"]
        assert len(found) >= len(claim.published) - len(missing), claim.text
        if claim.published:
            assert all(value > 0 for value in found.values()), f"the paper does not say: {claim.text}"
