"""Every file in conf/ is used here, so none of them can rot."""

import re
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from composed import composed, jobs

from baselines.padgs import preset
from padgs.cli.config import RunOptions, TrainConfig
from padgs.data.datasets import DATASETS
from padgs.method import RenderConfig
from padgs.model import PaDGSOptions
from padgs.protocols import PROTOCOLS, ROAM_360_BOTTOM_CROP
from padgs.train import TrainOptions

CONF = Path(__file__).resolve().parent.parent / "conf"
EXPERIMENTS = sorted(path.stem for path in (CONF / "experiment").glob("*.yaml"))


def files(*groups: str) -> list[str]:
    return sorted(f"{group}={path.stem}" for group in groups for path in (CONF / group).glob("*.yaml"))


@pytest.fixture(autouse=True)
def padgs_root(monkeypatch, root):
    monkeypatch.setenv("PADGS_ROOT", str(root))


def test_without_arguments_all_values_are_the_defaults_of_the_dataclasses():
    config = composed()
    assert config.method == "padgs" and config.options == preset("padgs")[0]
    assert config.render == RenderConfig()
    assert config.run == RunOptions()
    assert replace(config.train, iterations=1) == TrainConfig(iterations=1)
    assert config.protocols == PROTOCOLS
    assert config.data.path is None and config.data.generator == {"scene": "room"}


@pytest.mark.parametrize("choice", files("data", "method", "render", "train", "protocol"))
def test_every_choice_composes(choice):
    composed(choice)


def test_sweeps_are_found_and_multiply_with_experiments():
    assert [job.seed for job in jobs("+sweep=seeds")] == [0, 1, 2]
    both = jobs("+experiment=ablation", "+sweep=seeds")
    assert len({(job.variant, job.seed) for job in both}) == 12


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_composes_and_says_how_to_run_it(name):
    assert jobs(f"+experiment={name}")
    package, command, *_ = (CONF / "experiment" / f"{name}.yaml").read_text().splitlines()
    assert package == "# @package _global_"  # Hydra reads it only there
    assert re.match(rf"# padgs-run \+experiment={name}\b", command)


def test_the_release_preset_is_the_one_in_the_code():
    config = composed("method=padgs_release")
    method, render, train = preset("padgs_release")
    assert (config.options, config.render) == (method, render)
    assert asdict(train).items() <= asdict(config.train).items()


def test_a_choice_on_the_command_line_beats_what_the_method_brings():
    config = composed("method=omnigs", "train=default")
    assert config.train.weight == "solid_angle"


@pytest.mark.parametrize("name", ["ablation", "ablation_bar", "ablation_cat_tower"])
def test_the_ablation_is_the_four_rows_of_table_3(name):
    baseline, dagd, no_m, full = jobs(f"+experiment={name}")
    assert [job.variant for job in (baseline, dagd, no_m, full)] == ["baseline", "dagd", "dagd_daom_no_m", "full"]
    assert baseline.method == "omnigs"
    assert [job.method for job in (dagd, no_m, full)] == ["padgs"] * 3
    assert [job.train.weight for job in (baseline, dagd, no_m, full)] == ["uniform"] * 3 + ["solid_angle"]
    assert [job.options.tau for job in (dagd, no_m, full)] == [0.0, 0.9, 0.9]
    assert all(job.options.use_distortion for job in (dagd, no_m, full))
    # Nothing else differs, or the rows would not say what their titles say.
    assert replace(dagd.options, tau=0.9) == no_m.options == full.options
    for job in (baseline, dagd, no_m):
        assert (job.data, job.render, job.protocols, job.seed) == (full.data, full.render, full.protocols, full.seed)
        assert replace(job.train, weight="solid_angle") == full.train
    assert full.train.iterations == 30_000
    assert TrainOptions(weight=full.train.weight) == TrainOptions() and PaDGSOptions().tau == full.options.tau


@pytest.mark.parametrize("name", ["roam360", "ricoh360"])
def test_data_sets_have_the_size_and_voxels_of_the_paper(name):
    config = composed(f"data={name}")
    known = DATASETS[name]
    assert (config.data.dataset, config.data.width) == (name, known.width)
    assert config.data.voxel_size == known.voxel_size == config.options.voxel_size


def test_360roam_is_cut_for_the_paper_and_not_for_the_sphere():
    protocols = composed("data=roam360").protocols
    assert protocols["paper"].bottom_crop == ROAM_360_BOTTOM_CROP
    assert protocols["sphere"].bottom_crop == 0
