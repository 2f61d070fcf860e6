from dataclasses import replace

import pytest
import torch
from support.composed import composed
from support.rates import assert_log_linear
from support.tiny_scene import in_other_units, squared_error, tiny_scene

from padgs.baselines.egonerf import EgoNeRFMethod
from padgs.data.synthetic import SyntheticOptions, generate
from padgs.geometry.camera import Pinhole
from padgs.methods.egonerf.field import EgoNeRF, EgoNeRFOptions
from padgs.methods.egonerf.model import EgoNeRFModel
from padgs.render import RenderConfig
from padgs.runs.run import build_method
from padgs.scene import Scene, View
from padgs.training.options import Budget, TrainOptions

PHOTO = Pinhole(8, 6, 5.0, 5.0, 4.0, 3.0)
SMALL = EgoNeRFOptions(
    radial_nodes=16,
    polar_nodes=12,
    azimuth_nodes=36,
    density_components=4,
    appearance_components=8,
    hidden=32,
    coarse_samples=24,
    fine_samples=24,
    surroundings="outdoor",
    environment_height=16,
    rays=256,
)


def method(train: TrainOptions = EgoNeRFMethod.TRAIN, **options) -> EgoNeRFMethod:
    return EgoNeRFMethod(replace(SMALL, **options), RenderConfig(), train)


@pytest.fixture
def room(tmp_path, monkeypatch) -> Scene:
    monkeypatch.setenv("PADGS_CACHE", str(tmp_path))
    return generate(SyntheticOptions("room", 64, train_views=6, test_views=1, samples=1, points=500))


def test_the_room_is_learned(room):
    trained = method(coarse_samples=16, fine_samples=16, surroundings="auto")
    records = trained.fit(room, Budget(120))
    first = next(records)
    assert "indoor constants: density_shift -8.0" in first.events[0]
    start = squared_error(trained, room.test[0])
    losses = [record.loss for record in records]
    assert sum(losses[-10:]) / 10 < 0.6 * first.loss
    assert squared_error(trained, room.test[0]) < 0.6 * start  # measured: 0.18


def test_the_small_setting_has_less_than_a_million_parameters():
    scene, small = tiny_scene(), build_method(composed("method=egonerf_small"))
    next(small.fit(scene, Budget(1)))
    assert small.size().parameters <= 1_000_000
    assert small.size().bytes == 4 * small.size().parameters


def test_training_is_invariant_to_world_units():
    scenes = (tiny_scene(), in_other_units(tiny_scene(), 100.0))
    losses = [[record.loss for record in method().fit(scene, Budget(10))] for scene in scenes]
    assert losses[0] == pytest.approx(losses[1], rel=1e-3)


def test_masked_pixels_do_not_affect_training():
    """What lies under the mask may be anything: the training is the same."""
    scene = tiny_scene()
    mask = torch.ones(16, 32)
    mask[10:] = 0

    def painted(view: View, value: int) -> View:
        pixels = (view.image() * 255).round().to(torch.uint8)
        pixels[10:] = value
        return replace(view, load_pixels=lambda: pixels, load_mask=lambda: mask)

    images = []
    for value in (0, 200):
        trained = method()
        list(trained.fit(replace(scene, train=tuple(painted(view, value) for view in scene.train)), Budget(5)))
        images.append(trained.render(scene.test[0]).image)
    assert torch.equal(*images)


def test_row_weights_change_the_loss():
    losses = [
        next(method(replace(EgoNeRFMethod.TRAIN, weight=weight)).fit(tiny_scene(), Budget(1))).loss
        for weight in ("uniform", "solid_angle")
    ]
    assert losses[0] != losses[1]


@pytest.mark.parametrize(
    "render, train, reason",
    [
        ({"projection": "ray"}, {}, "renders no Gaussians, so render.projection=ray does not apply; leave it at erp"),
        ({"backend": "cpu"}, {}, "no backend 'cpu'; it casts rays in torch, known: auto, torch"),
        ({}, {"lambda_l1": 0.5}, "squared error .* so train.lambda_l1=0.5 does not apply; leave it at 0.8"),
        ({}, {"normalisation": "channel_sum"}, "train.normalisation=channel_sum does not apply"),
    ],
)
def test_options_of_splatting_are_refused(render, train, reason):
    train_options = replace(EgoNeRFMethod.TRAIN, **train)
    with pytest.raises(ValueError, match=reason):
        next(EgoNeRFMethod(SMALL, RenderConfig(**render), train_options).fit(tiny_scene(), Budget(1)))


@pytest.mark.parametrize("name, value", [("rays", 0), ("density_variation", -1.0)])
def test_invalid_training_options_are_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} is {value}"):
        method(**{name: value})


def test_variation_smooths_the_planes():
    scene, roughness = tiny_scene(), []
    for weight in (0.0, 1e4):
        trained = method(density_variation=weight, appearance_variation=0.0)
        list(trained.fit(scene, Budget(20)))
        roughness.append(trained.model.field.density.variation().item())
    assert roughness[1] < 0.5 * roughness[0]


def test_published_learning_rates():
    model = EgoNeRF.from_scene(tiny_scene(), SMALL)
    groups = {group.name: group for group in EgoNeRFModel(model, 100_000).groups()}
    starts = {"density": 0.02, "appearance": 0.02, "shader": 1e-3, "environment": 5e-3}
    assert groups.keys() == starts.keys()
    ends = {name: (start, 0.1 * start, [*getattr(model, name).parameters()]) for name, start in starts.items()}
    assert_log_linear(groups.values(), ends, 100_000)


def test_rates_decay_to_a_tenth():
    trained = method()
    for iteration, _ in enumerate(trained.fit(tiny_scene(), Budget(4)), start=1):
        groups = trained._trainer._optimizer.adam.param_groups
        assert {group["betas"] for group in groups} == {(0.9, 0.99)}
        rates = [group["lr"] / start for group, start in zip(groups[::3], (0.02, 5e-3), strict=True)]
        assert rates == pytest.approx(2 * [0.1 ** (iteration / 4)])


def test_published_weights_of_the_variation_fall_like_the_rates():
    model = EgoNeRF.from_scene(tiny_scene(), SMALL)
    with torch.no_grad():
        for plane in model.appearance.planes:
            plane.mul_(3)  # at first both vary alike, and could be mistaken for one another
    density, appearance = model.density.variation().item(), model.appearance.variation().item()
    trainable = EgoNeRFModel(model, 100_000)
    for iteration, share in ((0, 1.0), (50_000, 0.1**0.5), (100_000, 0.1)):
        expected = 1e-2 * share * (0.1 * density + 0.01 * appearance)
        assert trainable.regularisation(iteration).item() == pytest.approx(expected, rel=1e-5)


def test_published_training_options():
    options = composed("method=egonerf").options
    assert (options.rays, options.density_variation, options.appearance_variation) == (4096, 0.1, 0.01)


def test_photographs_beside_panoramas_are_trained_on():
    scene = tiny_scene()
    first, *others = scene.train
    photo = View("photo", first.cam_from_world, 8, 6, lambda: torch.zeros(6, 8, 3, dtype=torch.uint8), lens=PHOTO)
    trained = method()
    assert len([*trained.fit(replace(scene, train=(*others, photo)), Budget(2))]) == 2
