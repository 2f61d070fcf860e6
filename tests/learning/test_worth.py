"""How many rows are needed, of hand-made scores."""

import pytest
import torch

from padgs.learning.worth import LEAST, Worth, most_wanted, needed


def scored(*changes: float) -> Worth:
    change = torch.tensor(changes, dtype=torch.float64)
    return Worth(-change, change, change, change, torch.ones(len(changes), dtype=torch.int64), len(changes))


@pytest.mark.parametrize(
    ("psnr", "count"), [(90.0, 5), (60.0, 4), (40.0, 3), (37.0, 2), (20.5, 2), (19.5, 1), (-10.0, 1)]
)
def test_as_many_go_as_change_the_views_by_no_less_than_asked(psnr, count):
    found = scored(1e-4, 1.0, 1e-2, 9e-5, 2e-9)
    assert needed(found, psnr) == count
    assert most_wanted(found, count).tolist() == sorted([1, 2, 0, 3, 4][:count])


def test_a_tenth_stays_even_where_all_stand_in_for_each_other():
    assert needed(scored(*[0.0] * 1000), 44.0) == LEAST * 1000
