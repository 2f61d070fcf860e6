"""What every method promises, whatever it is: each, and each preset in conf/method, is trained for a few steps here.

A new method needs no line here, unless its defaults are too large for a test (`TINY`) or it is slow (`SLOW`).
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from support.composed import composed
from support.states import assert_same_but_time

from padgs.baselines import BUILT_IN, METHODS
from padgs.data.synthetic import SCENES, SyntheticOptions, generate
from padgs.methods.egonerf.model import RATES
from padgs.runs import checkpoint
from padgs.runs.config import RunConfig
from padgs.runs.run import build_method
from padgs.scene import Scene
from padgs.training.loop import Record
from padgs.training.method import Method
from padgs.training.options import Budget

WIDTH = 32
STEPS = 20
TINY_EGONERF = tuple(
    f"method.{name}={value}"
    for name, value in {
        **{"radial_nodes": 16, "polar_nodes": 12, "azimuth_nodes": 36, "environment_height": 16, "hidden": 16},
        **{"density_components": 4, "appearance_components": 4, "coarse_samples": 16, "fine_samples": 16, "rays": 128},
    }.items()
)
# setting -> overrides that make it small enough for a test
TINY: dict[str, tuple[str, ...]] = {"egonerf": TINY_EGONERF, "egonerf_small": TINY_EGONERF}
# Settings that only `make test-all` tries: PaD-GS with an option or two that have tests of their own.
SLOW = {"padgs_small", "padgs_tangent", "padgs_unmodulated"}
CONF = Path(__file__).resolve().parents[2] / "conf"
SETTINGS = sorted({*METHODS, *(path.stem for path in (CONF / "method").glob("*.yaml"))})
EVERY = [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in SETTINGS]


@pytest.fixture(scope="module")
def scenes(tmp_path_factory) -> Iterator[Callable[[str], Scene]]:
    """The synthetic scenes by their names, tiny."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PADGS_CACHE", str(tmp_path_factory.mktemp("cache")))
        for grid in ("density", "appearance"):
            patch.setitem(RATES, grid, 0.1)  # twenty steps shall show something
        yield cache(
            lambda name: generate(SyntheticOptions(name, WIDTH, train_views=3, test_views=1, samples=1, points=200))
        )


@cache
def config_of(setting: str, seed: int = 0) -> RunConfig:
    return composed(f"method={setting}", f"seed={seed}", *TINY.get(setting, ()))


def method_of(setting: str, seed: int = 0) -> Method:
    return build_method(config_of(setting, seed))


def trained(setting: str, scene: Scene, steps: int = STEPS, seed: int = 0) -> tuple[Method, list[Record]]:
    method = method_of(setting, seed)
    return method, list(method.fit(scene, Budget(steps)))


def test_every_method_has_a_setting_of_its_name():
    assert METHODS.keys() <= set(SETTINGS)
    assert {config_of(setting).method for setting in SETTINGS} == METHODS.keys()
    assert TINY.keys() | SLOW <= set(SETTINGS)


def test_every_method_has_a_line_in_the_table_of_the_docs(root):
    lines = (root / "docs" / "methods.md").read_text().splitlines()
    cells = [line.split("|")[1] for line in lines if line.startswith("| `")]
    assert [name for name in BUILT_IN if not any(f"`{name}`" in cell for cell in cells)] == []


@pytest.mark.parametrize("setting", EVERY)
def test_methods_train_and_render(setting, scenes):
    survives(setting, scenes("room"))


@pytest.mark.slow
@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("setting", SETTINGS)
def test_methods_train_on_every_synthetic_scene(setting, scene, scenes):
    survives(setting, scenes(scene))


def survives(setting: str, scene: Scene) -> None:
    method, records = trained(setting, scene)
    assert [record.iteration for record in records] == list(range(1, STEPS + 1))
    assert all(record.loss == record.loss and abs(record.loss) < float("inf") for record in records)
    assert all(a.seconds <= b.seconds for a, b in zip(records, records[1:], strict=False))
    for view in (scene.train[0], scene.test[0]):
        rendering = method.render(view)
        assert rendering.image.shape == (view.height, view.width, 3)
        assert torch.isfinite(rendering.image).all() and not rendering.image.requires_grad
        least = 0.003 if "bare" in scene.name else 0.01  # whose walls have nearly one colour after so few steps
        assert rendering.image.std() > least, "it shows something"
    size = method.size()
    assert size.parameters > 0 and size.bytes >= size.parameters and all(n > 0 for n in size.counts.values())


@pytest.mark.parametrize("setting", EVERY)
def test_untrained_methods_and_empty_scenes_are_refused(setting, scenes):
    method, scene = method_of(setting), scenes("room")
    for ask in (method.state, method.size, lambda: method.render(scene.test[0])):
        with pytest.raises(RuntimeError, match="call fit or load_state first"):
            ask()
    with pytest.raises(ValueError, match="scene 'synthetic-room' has no training view"):
        method.fit(replace(scene, train=()), Budget(STEPS))


@pytest.mark.parametrize("setting", EVERY)
def test_resuming_is_bit_identical(setting, scenes, tmp_path):
    scene, steps, stop = scenes("room"), 12, 7
    whole, _ = trained(setting, scene, steps)
    first = method_of(setting)
    records = first.fit(scene, Budget(steps))
    for _ in range(stop):
        next(records)
    checkpoint.save(first.state(), tmp_path)
    torch.manual_seed(stop)  # another process
    second = method_of(setting)
    second.load_state(checkpoint.load(tmp_path))
    assert second.size() == first.size(), "before the scene is known"
    assert torch.equal(second.render(scene.test[0]).image, first.render(scene.test[0]).image)
    assert [record.iteration for record in second.fit(scene, Budget(steps))] == list(range(stop + 1, steps + 1))
    assert_same_but_time(second.state(), whole.state())
    assert torch.equal(second.render(scene.test[0]).image, whole.render(scene.test[0]).image)


@pytest.mark.parametrize("setting", EVERY)
def test_seeds_determine_the_images(setting, scenes):
    images = []
    for seed in (0, 0, 1):
        torch.manual_seed(seed)  # as the run does
        method, _ = trained(setting, scenes("room"), 3, seed)
        images.append(method.render(scenes("room").test[0]).image)
    assert torch.equal(images[0], images[1]) and not torch.equal(images[0], images[2])
