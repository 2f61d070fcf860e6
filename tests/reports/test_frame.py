import math
from dataclasses import replace

import pandas as pd
import pytest
from support.made_up import external, failed, result, small

from padgs.baselines import BUILT_IN, METHODS
from padgs.checks import lookup
from padgs.reports import methods
from padgs.reports.frame import by_place, frame, images_seen, law
from padgs.reports.published import Place
from padgs.reports.store import Run
from padgs.training.schedule import Pace


def test_a_row_a_run_with_its_numbers_conditions_and_keys():
    made = frame([Run(small(25.0, 2.0)), Run(failed("full", "oom"))])
    assert made["ok"].tolist() == [True, False] and made["status"].tolist() == ["ok", "oom"]
    first = made.iloc[0]
    assert first["paper/psnr"] == 25 and first["sphere/ws_psnr"] == pytest.approx(24.6)
    assert first["fps"] == pytest.approx(1000 / 80) and first["train_hours"] == pytest.approx(200 / 3600)
    assert first["resolution"] == "512x256" and first["machine"] == "2 cores of A & B_1, torch 2.13.0"
    assert first["paper rules"] == "paper, LPIPS-vgg fed [0, 1]" and first["config.train.iterations"] == 1500
    assert made["paper/psnr"].isna().tolist() == [False, True]


def test_training_time_is_cpu_time_unless_a_gpu_trained():
    timing = {"train_seconds": 90.0, "cpu_seconds": 60.0}
    runs = [Run(replace(result("full"), timing=timing, machine={"gpu": gpu})) for gpu in (None, "H100")]
    assert frame(runs)["train_seconds"].tolist() == [60, 90] and frame(runs)["wall_seconds"].tolist() == [90, 90]


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


def test_learning_rates_of_a_run_of_seconds_do_not_depend_on_its_iterations():
    config = {"train": {"learning_rates": "run"}, "budget": {"seconds": 300.0, "clock": "wall"}}
    own = [replace(result("full"), iterations=count, config=config) for count in (29_990, 30_010)]
    assert frame([*map(Run, own)])["learning_rates"].tolist() == ["run", "run"]
    assert frame([Run(replace(own[1], config={"train": config["train"]}))])["learning_rates"].tolist() == ["published"]


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


def test_rays_count_as_pixels_and_all_else_as_whole_panoramas():
    rays = {"method": "egonerf", "width": 2048, "height": 1024, "config": {"method": {"rays": 4096}}}
    assert images_seen(result(**rays)) == 30_000 / 512
    for method in ("padgs", "cubemap_3dgs"):
        assert images_seen(result(method=method, iterations_done=120)) == 120
    assert images_seen(result(method="egonerf", config={})) is None


@pytest.mark.parametrize(("width", "seen"), [(512, 1000), (1022, 1000), (1024, None)])
def test_the_pixels_of_smaller_views_are_not_known(width, seen):
    own = {"method": "padgs_plus", "width": width, "height": width // 2, "iterations_done": 1000}
    assert images_seen(result(**own, config={"method": {"coarse_share": 0.3}})) == seen
    assert images_seen(result(**own, config={"method": {"coarse_share": 0.0}})) == 1000


def test_no_two_places_share_a_title_or_a_name_of_files():
    datasets, scenes = ("", "synthetic", "omniblender", "roam360"), ("room", "synthetic-room")
    places = [Place(dataset, scene, apart) for dataset in datasets for scene in scenes for apart in ("", "data 0123")]
    assert len({place.title for place in places}) == len({place.stem for place in places}) == len(places)
    assert [Place("", "room").stem, Place("synthetic", "synthetic-room").stem] == ["room", "synthetic-room"]


def test_limits_of_the_model_are_named_with_the_length():
    lengths = (
        {"gaussians": 20_000},
        {"gaussians": "auto", "stop": "auto"},
        {"seconds": 60.0, "clock": "cpu", "gaussians": 9},
    )
    made = [small(25.0, config={"budget": budget}, seed=seed) for seed, budget in enumerate(lengths)]
    assert frame(map(Run, made))["length"].tolist() == [
        "1500 iterations, at most 20 000 Gaussians",
        "1500 iterations, Gaussians as needed, until nothing is gained",
        "60 s of CPU time, at most 9 Gaussians",
    ]


def test_data_from_files_have_no_setting_of_the_generator():
    data = [{"path": "flat", "generator": {"width": 256}}, {"path": "flat"}, {"generator": {"width": 256}}]
    made = frame(map(Run, [small(25.0, config={"data": one}, seed=seed) for seed, one in enumerate(data)]))
    assert made["setting"].nunique() == 2 and made["setting"][0] == made["setting"][1]


def test_models_of_other_programs_have_no_learning_rates():
    made = frame(map(Run, [external(25.0, "Brush")]))
    assert made["learning_rates"].isna().all() and made["rate_factor"].isna().all()


def test_every_choice_of_learning_rates_has_a_factor(monkeypatch):
    rates = [{"train": {"learning_rates": choice, "iterations": 1500}} for choice in ("run", "run_linear", 4.0)]
    made = frame(map(Run, [small(25.0, config=config, iterations=1500) for config in rates]))
    assert made["rate_factor"].round(3).tolist() == [4.472, 2.0, 4.0]
    monkeypatch.setattr(methods, "outside", lambda method, attribute: "run_linear")
    monkeypatch.setattr("padgs.reports.frame.outside", methods.outside)
    assert law(1500, "mine") == 2.0 and law(1500, "spags") > 4, "the rule of another package's method is its class's"


@pytest.mark.parametrize("iterations", [1, 400, 1600, 6400, 30_000, 100_000])
def test_the_law_is_that_of_training(iterations):
    assert law(iterations) == Pace.of("run", iterations).factor
    for name in BUILT_IN:
        assert law(iterations, name) == Pace.of(lookup(METHODS, name, "method").RUN_RATES, iterations).factor, name
