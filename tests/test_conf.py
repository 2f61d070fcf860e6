"""Every file in conf/ is used here, so none of them can rot."""

import os
import re
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from hydra.errors import HydraException
from omegaconf import OmegaConf
from support.composed import composed, expanded, first_and_last_job, jobs

from padgs.baselines import METHODS
from padgs.checks import ConfigError, lookup
from padgs.data.datasets import DATASETS
from padgs.data.perturb import CONDITIONS
from padgs.data.synthetic.options import SyntheticOptions
from padgs.evaluation.protocols import PROTOCOLS, ROAM_360_BOTTOM_CROP
from padgs.methods.anchors.anchors import PaDGSOptions
from padgs.methods.anchors.growth import PUBLISHED_THRESHOLD
from padgs.methods.anchors.method import PaDGSMethodOptions
from padgs.methods.plus.method import PlusMethod, PlusOptions
from padgs.multirun.composition import composing, configuration, variant_choices
from padgs.multirun.overrides import expand, lenient, missing_plugin, problem, quoted
from padgs.render import RenderConfig
from padgs.reports.conditions import CALIBRATES
from padgs.runs.config import RunOptions, TrainConfig, method_choices
from padgs.runs.tracking import TrackingOptions
from padgs.training.options import TrainOptions

CONF = Path(__file__).resolve().parent.parent / "conf"
EXPERIMENTS = sorted(path.stem for path in (CONF / "experiment").glob("*.yaml"))
SWEEPS = sorted(path.stem for path in (CONF.parent / "sweeps" / "sweep").glob("*.yaml"))


def files(*groups: str) -> list[str]:
    return sorted(f"{group}={path.stem}" for group in groups for path in (CONF / group).glob("*.yaml"))


def registered() -> list[str]:
    return [f"{group}={name}" for name in METHODS for group, _ in method_choices(name) if group != "method"]


@pytest.fixture(autouse=True)
def padgs_root(monkeypatch, root):
    monkeypatch.setenv("PADGS_ROOT", str(root))


def test_without_arguments_all_values_are_the_defaults_of_the_dataclasses():
    config = composed()
    assert config.method == "padgs_plus" and config.options == PlusOptions()
    assert config.render == PlusMethod.RENDER
    paper = composed("method=padgs")
    assert paper.options == PaDGSMethodOptions() and paper.render == RenderConfig()
    assert config.run == RunOptions() and config.tracking == TrackingOptions()
    assert replace(paper.train, iterations=1) == TrainConfig(iterations=1)
    of_plus = {name: getattr(PlusMethod.TRAIN, name) for name in vars(PlusMethod.TRAIN)}
    assert replace(config.train, iterations=1) == TrainConfig(iterations=1, **of_plus)
    assert config.protocols == {name: PROTOCOLS[name] for name in ("paper", "sphere")}
    assert config.data.path is None and config.data.generator == {"scene": "room"}


@pytest.mark.parametrize("choice", [*files("data", "render", "train", "protocol", "tracking", "budget"), *registered()])
def test_every_choice_composes(choice):
    group, name = choice.split("=")
    method = {"render": name, "train": name} if name in METHODS else {"render": "padgs", "train": "padgs"}
    composed(*([f"method={method[group]}"] if group in method else []), choice)


def test_sweeps_multiply_with_experiments():
    both = jobs("+experiment=ablation", "+sweep=seeds")
    assert len({(job.variant, job.seed) for job in both}) == 12


@pytest.mark.parametrize("name", SWEEPS)
def test_every_sweep_varies_its_key_alone_and_says_how_to_run_it(name):
    package, command, *_ = (CONF.parent / "sweeps" / "sweep" / f"{name}.yaml").read_text().splitlines()
    assert (package, command) == ("# @package _global_", f"# padgs-run +sweep={name}")
    found = jobs(f"+sweep={name}")
    keys = {
        "backends": {"render.backend"},
        "gaussians": {"budget"},
        "growth_threshold": {"method.gradient_threshold"},
        "iterations": {"train.iterations"},
        "learning_rate_factor": {"train.learning_rates"},
        "lambda": {"train.lambda_l1"},
        "offset_rate": {"method.offset_rate"},
        "omega_axis": {"method.omega_axis"},
        "offsets_and_features": {"method.offsets", "method.features"},
        "projections": {"render.projection", "render.cubemap"},
        "resolution": {"data.width"},
        "seeds": {"seed"},
        "tau": {"method.tau"},
        "voxel_size": {"method.voxel_pixels"},
    }[name]
    differing = {key for job in found for key in different_keys(found[0].values(), job.values())}
    assert differing == keys
    assert all(job.labels.experiments == (name,) for job in found)
    assert len(found) > 1 and len({str(job.values()) for job in found}) == len(found)


def different_keys(first: dict, second: dict, where: str = "") -> set[str]:
    """Dotted keys in which two configurations differ."""
    found = set()
    for key in first.keys() | second.keys():
        mine, theirs = first.get(key), second.get(key)
        if isinstance(mine, dict) and isinstance(theirs, dict):
            found |= different_keys(mine, theirs, f"{where}{key}.")
        elif mine != theirs:
            found.add(f"{where}{key}")
    return found


def test_what_the_command_line_sweeps_multiplies_with_the_file_or_replaces_it():
    with composing() as loader:
        params = {"method.tau": "0.5,0.9", "+scene": "glob(synthetic_out*)", "seed": "0,1,2"}
        found = expand(params, ["++seed=7,8", "+sweep=tau"], loader)
    assert found == [
        [f"++method.tau={tau}", "+scene=synthetic_outdoor", f"++seed={seed}", "+sweep=tau"]
        for tau in (0.5, 0.9)
        for seed in (7, 8)
    ]


def test_a_value_given_twice_is_one_job():
    with composing() as loader:
        assert expand({}, ["seed=0,1,1"], loader) == [["seed=0"], ["seed=1"]]


def test_a_sweep_of_too_many_jobs_is_refused():
    with composing() as loader:
        for settings in (["seed=range(1,1e9)"], ["seed=range(0,101)", "train.iterations=range(1,101)"]):
            with pytest.raises(ValueError, match="more than 10000 jobs"):
                expand({}, settings, loader)


@pytest.mark.parametrize("setting", ["+scene=glob(roam36_*)", "seed=range(5,1)"])
def test_a_sweep_of_nothing_is_refused(setting):
    with (
        composing() as loader,
        pytest.raises(ValueError, match=f"^{re.escape(setting)} has no value; correct the name"),
    ):
        expand({}, [setting], loader)


def test_a_sweep_of_folders_is_refused():
    with composing() as loader, pytest.raises(ValueError, match="^run.folder=a,b has several values; use one command"):
        expand({}, ["run.folder=a,b"], loader)


def test_one_folder_beside_several_scenes_is_refused():
    params = {"+scene": "synthetic_room,synthetic_outdoor"}
    with composing() as loader:
        with pytest.raises(ValueError, match="^data.path names one folder, beside 2 scenes; .* ~scene_set"):
            expand(params, ["++data.path=mine"], loader)
        assert expand({}, ["++data.path=mine,other"], loader) == [["++data.path=mine"], ["++data.path=other"]]


@pytest.mark.parametrize("launcher", [[], ["launcher=slurm"], ["launcher=ray"]])
def test_a_number_of_jobs_that_a_launcher_does_not_read_is_refused(launcher):
    refusal = problem(["-m", *launcher, "run.jobs=4"])
    assert "run.jobs=4 is for launcher=local or submitit" in refusal and "array_parallelism" in refusal
    assert problem(["-m", "launcher=local", "run.jobs=4"]) is None


def test_the_tables_of_the_paper_are_all_of_its_scenes_times_all_of_its_methods():
    for name, known in (("table1_360roam", "roam360"), ("table2_ricoh360", "ricoh360")):
        pairs = [dict(setting.split("=") for setting in job) for job in expanded(f"+experiment={name}")]
        scenes = {f"{known}_{scene}" for scene in DATASETS[known].scenes}
        assert {pair["+scene"] for pair in pairs} == scenes
        assert len(pairs) == len(scenes) * len({pair["method"] for pair in pairs})
        first, _ = first_and_last_job(f"+experiment={name}")
        folder = DATASETS[known].folder
        assert first.data.path == f"data/{folder}/{DATASETS[known].scenes[0]}" and first.data.dataset == known
        assert first.train.iterations == 30_000 and first.labels.experiments == (name,)


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_also_runs_on_a_bare_machine(name):
    for job in first_and_last_job(f"+experiment={name}", "scale=cpu"):
        assert job.data.path is None and job.data.dataset is None
        assert job.data.generator["width"] <= 512 and job.train.iterations <= 1500
        assert job.labels.experiments == (f"{name}@cpu",)


def test_one_scene_indoors_and_one_outdoors_stand_in_for_the_data_sets():
    scenes = {
        name: {job.data.generator["scene"] for job in first_and_last_job(f"+experiment={name}", "scale=cpu")}
        for name in ("table1_360roam", "ablation_bar", "table2_ricoh360", "ablation_cat_tower", "table4_efficiency")
    }
    room, outdoor = {"room"}, {"outdoor"}
    assert list(scenes.values()) == [room, room, outdoor, outdoor, room | outdoor]


def test_the_stress_experiment_puts_every_method_under_every_condition_and_under_none():
    stresses = {tuple(setting for setting in job if "stress." in setting) for job in expanded("+experiment=stress")}
    names = ("none", *CONDITIONS)
    assert stresses == {(f"++stress.condition={name}", f"++stress.level={n}") for name in names for n in (1, 2, 3)}


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_composes_and_says_how_to_run_it(name):
    assert first_and_last_job(f"+experiment={name}")
    package, command, *_ = (CONF / "experiment" / f"{name}.yaml").read_text().splitlines()
    assert package == "# @package _global_"  # Hydra reads it only there
    assert re.match(rf"# padgs-run \+experiment={name}\b", command)


@pytest.mark.parametrize("choice", ["+experiment=foo", "+sweep=foo", "+scene=foo", "launcher=foo", "tracking=foo"])
def test_unknown_choices_are_answered_with_the_known_ones(choice):
    with pytest.raises(HydraException, match="Available options in '"):
        composed(choice)


@pytest.mark.parametrize("name", ['Jürgen\'s "flat" (2), [old]: $5 = 50 %\\', "20240801", "it's"])
def test_files_and_folders_may_have_any_names(name):
    config = composed(f"data.path={name}", f"data.images={name}", f"run.folder=~/{name}")
    assert config.data.path == config.data.images == name
    assert config.run.folder == os.path.expanduser(f"~/{name}")


def test_several_folders_are_several_jobs():
    with composing() as loader:
        settings = quoted(["-m", 'data.path=~/flat (1),"a,b", c', "seed=choice(0,1)"])
        found = {configuration(job).data.path for job in expand({}, lenient(settings[1:]), loader)}
    assert found == {os.path.expanduser("~/flat (1)"), "a,b", "c"}


def test_an_array_of_slurm_is_no_longer_than_it_allows_by_itself():
    assert OmegaConf.load(CONF / "launcher" / "slurm.yaml").hydra.sweeper.max_batch_size <= 1001


@pytest.mark.parametrize("name", ["none", "local", "slurm", "submitit", "ray"])
def test_every_launcher_composes(name):
    if missing_plugin([f"launcher={name}"]):
        pytest.skip(f"the plugin of launcher {name} is not installed")
    assert composed(f"launcher={name}").run.jobs >= 1


def test_the_release_of_padgs_differs_from_the_paper_where_its_code_does():
    paper, released = composed("method=padgs"), composed("method=padgs_release")
    given, changed = asdict(paper.options), asdict(released.options)
    assert {key: value for key, value in changed.items() if value != given[key]} == {
        "omega_axis": "world_z",
        "omega_input": "cos",
        "max_modulated_omega": 1 - 1e-4,
        "distance_unit": "world",
        "offset_rate": (0.01, 0.0001),
        "offset_rate_unit": "world",
        "gradient_threshold": PUBLISHED_THRESHOLD,
        "log_scale_cap": 0.05,
        "max_anchors": None,
        "min_extent": 0.0,
    }
    assert released.render == RenderConfig(near=0.2, near_unit="world", wrap=False, bounds="square")
    assert (released.train.weight, released.train.normalisation) == ("end_rows", "channel_sum")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            ["render.bounds=square"],
            "render: bounds=square end at the seam, as published; set wrap=false",
        ),
        (
            ["method=omnigs", "render.near_cull=ellipsoid"],
            "near_cull=ellipsoid requires projection 'ray', not 'erp'",
        ),
        (["method=spags_sorted", "render.core_size=8"], "core_size is 8, but blending=sorted has no core"),
        (["render.near_unit=metre"], "unknown near_unit 'metre'; known: scene, world"),
        (
            ["method=padgs", "data=roam360", "method.voxel_pixels=3"],
            "voxel_pixels is 3.0, but voxel_size is 0.001 world units; set voxel_size=auto or voxel_pixels=0.1",
        ),
        (["budget.clock=cpu"], "clock is cpu, but there are no seconds to measure; set budget.seconds"),
    ],
)
def test_what_would_have_no_effect_is_refused_before_anything_is_read(settings, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        composed(*settings)


@pytest.mark.parametrize("name", sorted(METHODS.keys() - {"padgs"}))
def test_every_method_is_drawn_and_trained_as_its_class_says(name):
    method, config = lookup(METHODS, name, "method"), composed(f"method={name}")
    assert (config.options, config.render) == (method.Options(), method.RENDER)
    assert asdict(method.TRAIN).items() <= asdict(config.train).items()


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


def test_every_rung_of_the_ladder_changes_one_thing():
    rungs = jobs("+experiment=ladder")
    first, *changes = [
        different_keys(low.values(), high.values()) - {"variant"} for low, high in zip(rungs, rungs[1:], strict=False)
    ]
    assert {rungs[0].method, *(rung.method for rung in rungs[1:])} == {"omnigs", "padgs"} and rungs[
        0
    ].method == "omnigs"
    assert all(key.startswith("method.") for key in first), "explicit Gaussians give way to anchors, all else stays"
    assert changes == [
        {"method.use_distance"},
        {"method.use_distortion"},
        {"method.tau"},
        {"train.weight"},
        {"train.normalisation"},
    ]
    assert [rung.options.inputs for rung in rungs[1:4]] == [35, 36, 37]
    # The last is the paper's method: its threshold, three times ours, on a loss three times ours.
    paper = composed("method=padgs", "train.iterations=30000")
    assert replace(rungs[-1].options, gradient_threshold=paper.options.gradient_threshold) == paper.options
    assert rungs[-1].options.gradient_threshold == pytest.approx(3 * paper.options.gradient_threshold)
    assert replace(rungs[-1].train, normalisation="mean") == paper.train


@pytest.mark.parametrize(
    ("settings", "setting"),
    [
        (("+ablation=baseline", "method=spags"), "method=spags"),
        (("+ablation=baseline", "+sweep=omega_axis", "+experiment=ablation"), "method=padgs"),
        (("+ablation=a6_triple_loss", "method.use_distance=false"), "method.use_distance=False"),
    ],
)
def test_a_row_of_a_table_is_what_its_title_says(settings, setting):
    with pytest.raises(ConfigError, match=rf"\{settings[0]} means .*, but {setting} was set besides"):
        composed(*settings)


def test_every_deviation_is_a_part_of_its_release_and_changes_something():
    found = {job.variant: job for job in jobs("+experiment=deviations")}
    assert found.keys() == variant_choices()["deviation"].keys()
    for name, job in found.items():
        method = name.partition("_")[0]
        described, released = found[method].values(), found[f"{method}_all"].values()
        changed = different_keys(described, job.values()) - {"variant"}
        assert bool(changed) == (name != method)
        assert not changed & different_keys(job.values(), released), "and to what the release has"


def test_calibration_is_compared_where_its_claims_can_show_and_where_not():
    """Each scene is one that the tables know as such, and the three methods see the same one."""
    found = jobs("+experiment=calibration", "scale=cpu")
    knobs = {key: {job.data.generator.get(key, 0) > 0 for job in found} for keys in CALIBRATES.values() for key in keys}
    assert all(there == {True, False} for there in knobs.values())
    methods_of: dict[str, list[str]] = {}
    for job in found:
        methods_of.setdefault(SyntheticOptions(**job.data.generator).title, []).append(job.method)
    assert methods_of.keys() == {f"synthetic-room{fault}" for fault in ("", "-noisy-poses", "-two-lenses")}
    assert all(methods == ["omnigs", "sc_omnigs", "seam360gs"] for methods in methods_of.values())
    noisy, lenses = (SyntheticOptions(**job.data.generator) for job in (found[3], found[6]))
    assert noisy.pose_noise_rotation and not noisy.lens_gap and lenses.lens_gap and not lenses.pose_noise_rotation


@pytest.mark.parametrize("projection", ["tangent", "ray"])
def test_padgs_on_another_projection_differs_in_nothing_else(projection):
    other, paper = composed(f"method=padgs_{projection}"), composed("method=padgs")
    differing = different_keys(paper.values(), other.values())
    assert differing - {"render.low_pass_kind"} == {"render.projection"}
    assert other.render.projection == projection
    assert other.render.options(1.0).resolved_low_pass_kind == "angular"


@pytest.mark.parametrize(("name", "voxel_size"), [("roam360", 0.001), ("ricoh360", 0.005)])
def test_data_sets_have_the_size_and_voxels_of_the_paper(name, voxel_size):
    config = composed(f"data={name}", "method=padgs")
    assert (config.data.dataset, config.data.width) == (name, DATASETS[name].width)
    assert config.data.voxel_size == voxel_size == config.options.voxel_size


def test_360roam_is_cut_for_the_paper_and_not_for_the_sphere():
    protocols = composed("data=roam360").protocols
    assert protocols["paper"].bottom_crop == ROAM_360_BOTTOM_CROP
    assert protocols["sphere"].bottom_crop == 0
