import math
from dataclasses import replace

import pandas as pd
import pytest
from made_up import failed, result, small

from padgs.reports.frame import by_place, frame
from padgs.reports.store import Run


def test_a_row_a_run_with_its_numbers_conditions_and_keys():
    made = frame([Run(small(25.0, 2.0)), Run(failed("full", "oom"))])
    assert made["ok"].tolist() == [True, False] and made["status"].tolist() == ["ok", "oom"]
    first = made.iloc[0]
    assert first["paper/psnr"] == 25 and first["sphere/ws_psnr"] == pytest.approx(24.6)
    assert first["fps"] == pytest.approx(1000 / 80) and first["train_hours"] == pytest.approx(200 / 3600)
    assert first["resolution"] == "512x256" and first["machine"] == "2 cores of A & B_1, torch 2.13.0"
    assert first["paper rules"] == "paper, LPIPS-vgg fed [0, 1]" and first["config.train.iterations"] == 1500
    assert made["paper/psnr"].isna().tolist() == [False, True]


def test_what_was_logged_last_is_a_number_of_the_run():
    log = {"iteration": [5, 9], "seconds": [1.0, 2.0], "psnr": [20.0, 21.0], "polar_transmittance": [0.2, 0.1]}
    found = frame([Run(small(25.0), log), Run(small(26.0))])["polar_transmittance"]
    assert found[0] == 0.1 and math.isnan(found[1])


def test_keys_keep_their_values_and_are_none_where_there_are_none():
    config = {"method": {"offset_rate": [0.1, 0.2], "levels": 3}, "seed": 0}
    made = frame([Run(result("full")), Run(replace(result("full"), config=config))])
    assert made["config.method.levels"].tolist() == [None, 3], "no number with a point"
    assert made["config.method.offset_rate"].tolist() == [None, [0.1, 0.2]]


def test_two_settings_differ_in_more_than_seed_and_folder():
    keys = ({"seed": 1}, {"run": {"folder": "b"}}, {"data": {"path": "c"}}, {"method": {"tau": 0.5}})
    runs = [Run(replace(result("full"), config=result("full").config | own)) for own in ({}, *keys)]
    assert (frame(runs)["setting"].duplicated(keep=False)).tolist() == [True, True, True, True, False]


def test_a_run_of_seconds_that_failed_before_its_first_iteration_has_no_learning_rates():
    own = replace(failed("full", "oom"), iterations=0, config={"train": {"learning_rates": "run"}})
    assert frame([Run(own)])["learning_rates"].tolist() == [None]


def test_without_runs_the_columns_are_there():
    made = frame([])
    assert made.empty and by_place(made) == {}
    assert {"run", "place", "ok", "train_seconds", "fps"} <= {*made}
    assert made.columns.is_unique and made["ok"].dtype == bool


def test_scenes_of_the_paper_stand_first():
    scenes = ("", "flat"), ("synthetic", "room"), ("ricoh360", "farm"), ("roam360", "lab"), ("roam360", "bar")
    runs = [Run(replace(result("full"), dataset=dataset, scene=scene)) for dataset, scene in scenes]
    groups = by_place(frame(runs))
    assert [place.scene for place in groups] == ["bar", "lab", "farm", "flat", "room"]
    assert all(isinstance(own, pd.DataFrame) and len(own) == 1 for own in groups.values())
