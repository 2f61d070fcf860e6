import pytest
from omegaconf import OmegaConf
from support.composed import composed

from padgs import results
from padgs.checks import ConfigError
from padgs.runs.store import RunStore, config_hash, run_id


@pytest.fixture(autouse=True)
def padgs_root(monkeypatch, root):
    monkeypatch.setenv("PADGS_ROOT", str(root))


def name(*overrides: str, scene: str = "room", fingerprint: str = "f00d") -> str:
    return run_id(composed("method=padgs", *overrides).values(), scene, fingerprint)


def test_it_reads_like_what_it_is():
    assert name("+ablation=dagd").startswith("room_padgs_dagd_")
    assert name().startswith("room_padgs_")
    assert name(scene="../house 3/u\u0308_1").startswith("house-3-ü-1_padgs_")


@pytest.mark.parametrize("scene", ["客厅", "Квартира 2", "λ", "a" * 200, "客" * 200])
def test_scenes_in_all_languages_have_readable_names_of_a_length_that_files_may_have(scene):
    for variant in (70 * "x", 70 * "客"):
        found = run_id(composed("method=padgs").values() | {"variant": variant}, scene, "f00d")
        assert found.startswith(scene[:30].replace(" ", "-"))
        assert len(found.encode()) < 255 and results.PLAIN.fullmatch(found)


def test_a_variant_that_results_could_not_hold_is_refused():
    with pytest.raises(ConfigError, match="variant has 151 letters; give at most 150"):
        composed("method=padgs", "variant=" + 151 * "x")


@pytest.mark.parametrize(
    "same",
    [
        "run.threads=1",
        "run.folder=elsewhere",
        "data.path=/mnt/x",
        "data.cache_bytes=1",
        "render.max_instances=1000",
        "protocol=paper",
        "seed=0",
    ],
)
def test_paths_machine_and_scoring_are_no_part_of_it(same):
    assert name(same) == name()


@pytest.mark.parametrize(
    "other",
    [
        "seed=1",
        "method=omnigs",
        "method.tau=0.5",
        "train.iterations=7",
        "render.wrap=false",
        "data.width=64",
        "variant=a",
    ],
)
def test_whatever_changes_numbers_changes_it(other):
    assert name(other) != name()


def test_other_data_is_another_run():
    assert name(fingerprint="f00d") != name(fingerprint="beef")


def test_spelling_of_numbers_does_not_matter():
    assert name("method.tau=1") == name("method.tau=1.0")
    assert name("train.iterations=2000") == name("train.iterations=2e3")


def test_the_hash_of_a_configuration_survives_its_file(tmp_path):
    values = composed("method=padgs", "method.tau=0.5", "method.offset_rate=[0.02,1e-5]").values()
    RunStore(tmp_path).prepare(values)
    stored = OmegaConf.to_container(OmegaConf.load(tmp_path / results.CONFIG_NAME))
    assert config_hash(stored) == config_hash(values)
