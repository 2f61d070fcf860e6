import csv

import pytest

import padgs.data
from padgs.data.datasets import DATASETS
from padgs.reports import published
from padgs.reports.published import SAME_DATA, Key, Place, load


def test_a_number_of_each_table():
    numbers = load()
    assert numbers[Key(1, "360roam", "bar", "padgs", "psnr")].value == 23.40
    assert numbers[Key(2, "ricoh360", "farm", "op43dgs", "psnr")].status == "oom"
    assert numbers[Key(3, "ricoh360", "cat_tower", "padgs/full", "lpips")].value == 0.187
    assert numbers[Key(4, "360roam", "average", "padgs", "fps")].value == 29.87


def test_a_capture_is_known_whatever_processor_computed_its_fingerprint(shared):
    assert (
        Place.of("", "basement", "4656e179f3ab").seen == Place.of("", "basement", "82d09f11c6ab").seen == "not tuned on"
    )
    for scene, first in (("basement", "82d09f11c6"), ("bedroom", "d090e1eaac")):
        assert SAME_DATA[padgs.data.load(shared / "data" / scene, width=256).fingerprint[:10]] == first


def test_every_cell_has_a_number_or_a_reason():
    with published.FILE.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row for row in rows if bool(row["value"]) != (row["status"] == "ok")] == []
    assert {cell.status for cell in load().values() if cell.value is None} == {"oom", ""}


def test_averages_are_those_of_the_scenes():
    numbers = load()
    columns = {(k.table, k.dataset, k.method, k.metric) for k in numbers if k.scene == "average" and k.table < 3}
    for table, dataset, method, metric in columns:
        average = numbers[Key(table, dataset, "average", method, metric)]
        cells = [
            cell
            for key, cell in numbers.items()
            if (key.table, key.dataset, key.method, key.metric) == (table, dataset, method, metric)
            and key.scene != "average"
        ]
        if average.value is None:
            assert any(cell.value is None for cell in cells)
            continue
        mean = sum(cell.value for cell in cells) / len(cells)
        half_a_digit = 0.0051 if metric == "psnr" else 0.00051
        assert mean == pytest.approx(average.value, abs=2 * half_a_digit), (table, method, metric)


def test_it_is_the_file_that_came_with_the_paper(shared):
    with (shared / "paper" / "published.csv").open() as theirs, published.FILE.open() as ours:
        assert list(csv.reader(ours)) == list(csv.reader(theirs))


def test_scenes_are_called_as_the_folders_of_the_data_set_are():
    for ours, theirs in published.DATASETS.items():
        assert set(published.scenes(load(), theirs)) == set(DATASETS[ours].scenes)
