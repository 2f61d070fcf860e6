"""The radiance field of EgoNeRF, its environment map and its constants by surroundings."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from support.tiny_scene import in_other_units, tiny_scene
from torch.nn.functional import normalize, softplus

from padgs.data.synthetic import SyntheticOptions, generate
from padgs.geometry.camera import Pinhole, RayTable
from padgs.methods.egonerf.field import (
    Constants,
    EgoNeRF,
    EgoNeRFOptions,
    EnvironmentMap,
    cloud_reach,
    surroundings_of,
)
from padgs.scene import Scene, View

SMALL = EgoNeRFOptions(
    radial_nodes=16,
    polar_nodes=8,
    azimuth_nodes=24,
    density_components=4,
    appearance_components=4,
    features=6,
    hidden=16,
    coarse_samples=24,
    fine_samples=24,
    surroundings="outdoor",
    near=0.05,
    far=8.0,
    first_radius=0.05,
    environment_height=8,
)


def dense(options: EgoNeRFOptions = SMALL, scene: Scene | None = None) -> EgoNeRF:
    """A model of which rays see something: its fields are strong instead of nearly empty."""
    model = EgoNeRF.from_scene(scene or tiny_scene(), options, seed=3)
    with torch.no_grad():
        for factor in model.density.parameters():
            factor.mul_(10)
        model.shader.basis.mul_(30)
    return model


def without_density(options: EgoNeRFOptions) -> EgoNeRF:
    """A model whose density is softplus(shift) everywhere."""
    model = dense(options)
    with torch.no_grad():
        for factor in model.density.parameters():
            factor.zero_()
    return model


def rays(count: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    origins = 0.2 * torch.randn(count, 3, generator=generator)
    return origins, normalize(torch.randn(count, 3, generator=generator), dim=-1)


def test_published_number_of_parameters():
    """Per chart (150 x 172 + 150 x 516 + 172 x 516 + 150 + 172 + 516) x 64 values of the grids."""
    with torch.device("meta"):
        model = EgoNeRF(EgoNeRFOptions(), torch.zeros(3, device="cpu"), 1.0, 1.0, "outdoor")
    grids = sum(p.numel() for part in (model.density, model.appearance) for p in part.parameters())
    assert grids == 2 * 64 * (150 * 172 + 150 * 516 + 172 * 516 + 150 + 172 + 516)
    assert 12.2e6 < grids / 2 < 12.4e6
    assert model.environment is not None and model.environment.emission.numel() == 3 * 1920 * 3840
    assert 46e6 < sum(p.numel() for p in model.parameters()) < 47.5e6


@pytest.mark.parametrize(
    ("surroundings", "unit", "published"),
    [("outdoor", 5.0, (-10.0, 25.0, 0.1, 300.0, 0.05, True)), ("indoor", 2.5, (-8.0, 25.0, 0.01, 15.0, 0.03, False))],
)
def test_scene_units_match_published_constants(surroundings, unit, published):
    """Lengths are published in units of the data; the optical depth of a length is the same, too."""
    assert EgoNeRFOptions().constants(surroundings).in_units_of(1 / unit) == pytest.approx(Constants(*published))


def test_constant_density_absorbs_exponentially(generator):
    model = without_density(replace(SMALL, surroundings="indoor"))
    model.constants = model.constants._replace(density_shift=-3.0, distance_scale=125.0)
    origins, directions = rays(20, generator)
    seen = model.trace(origins, directions)
    distances = model._sample(origins, directions, None)
    length = distances[:, -1] - distances[:, 0] + (distances[:, -1] - distances[:, -2])
    expected = torch.exp(-softplus(torch.tensor(-3.0)) * model.constants.distance_scale * length)
    assert torch.allclose(seen.transmittance, expected, rtol=1e-3, atol=1e-12)


@pytest.mark.parametrize("environment", [True, False])
def test_empty_space_shows_the_environment_or_black(generator, environment):
    model = without_density(replace(SMALL, surroundings="outdoor" if environment else "indoor"))
    model.constants = model.constants._replace(density_shift=-200.0)
    origins, directions = rays(20, generator)
    seen = model.trace(origins, directions)
    behind = model.environment(directions) if environment else torch.zeros(20, 3)
    assert (model.environment is not None) == environment
    assert torch.allclose(seen.color, behind, atol=1e-6)
    assert torch.equal(seen.transmittance, torch.ones(20)) and (seen.depth == 0).all()


def test_samples_start_at_near_reach_far_and_increase(generator):
    model = dense()
    origins, directions = rays(50, generator)
    distances = model._sample(origins, directions, generator)
    assert distances.shape == (50, 48) and (distances.diff(dim=-1) >= 0).all()
    still = model._sample(origins, directions, None)
    assert torch.equal(still[:, 0], torch.full((50,), model.constants.near))
    assert (still[:, -1] >= model.constants.far - 1e-4).all()


def test_fine_samples_concentrate_at_a_shell(generator):
    """Density in one radial node only: half the samples are drawn to it."""
    model = without_density(SMALL)
    with torch.no_grad():
        model.density.planes[2].fill_(3.0)  # polar x azimuth, whose line runs along the radius
        model.density.lines[2][:, :, 8:10] = 3.0
    nodes = model.get_buffer("nodes")
    directions = normalize(torch.randn(50, 3, generator=generator), dim=-1)
    distances = model._sample(torch.zeros(50, 3), directions, None)
    near_shell = (distances > nodes[5]) & (distances < nodes[12])
    assert near_shell.float().sum(-1).min() > 24


def test_cameras_agree_along_equal_rays():
    """A table of the panorama's own rays gives the panorama; a pinhole's middle is the panorama's."""
    scene, model = tiny_scene(), dense()
    view = scene.test[0]
    panorama = model.render(view)
    table = RayTable(view.camera.rays(), view.camera.focal)
    assert torch.equal(model.render(replace(view, lens=table)).image, panorama.image)
    forward = Pinhole(3, 3, 50.0, 50.0, 1.5, 1.5)
    middle = model.render(replace(view, width=3, height=3, lens=forward)).image[1, 1]
    origin = model.from_world(view.center)[None]
    along = view.cam_from_world[2:3, :3].float()
    assert torch.allclose(middle, model.trace(origin, along).color[0], atol=1e-5)


def test_depth_and_transmittance_of_a_rendering():
    scene, model = tiny_scene(), dense()
    view = scene.test[0]
    rendering = model.render(view)
    assert rendering.depth.shape == rendering.transmittance.shape == (view.height, view.width)
    assert ((rendering.transmittance >= 0) & (rendering.transmittance <= 1)).all()
    seen = rendering.transmittance < 0.5
    assert seen.any() and (rendering.depth[seen] >= model.constants.near * model.unit * 0.99).all()
    assert rendering.depth.max() <= model.get_buffer("distances")[-1] * model.unit * 1.01
    assert len(rendering.visible) == 0 and rendering.counters["rays"] == view.width * view.height


def test_passes_do_not_change_the_image():
    scene = tiny_scene()
    whole, parts = dense(), dense(replace(SMALL, samples_at_once=48 * 7))
    view = scene.test[0]
    assert torch.allclose(whole.render(view).image, parts.render(view).image, atol=1e-6)


def test_min_weight_bounds_the_error():
    scene, view = tiny_scene(), tiny_scene().test[0]
    full, quick = dense(scene=scene), dense(replace(SMALL, min_weight=1e-3), scene)
    difference = (full.render(view).image - quick.render(view).image).abs().max()
    assert 0 < difference <= SMALL.samples * 1e-3


@pytest.mark.parametrize("scale", [0.01, 100.0])
def test_rendering_is_invariant_to_world_units(scale):
    scene = tiny_scene()
    other = in_other_units(scene, scale)
    plain, scaled = dense(scene=scene), dense(scene=other)
    assert scaled.unit == pytest.approx(scale * plain.unit)
    a, b = plain.render(scene.test[0]), scaled.render(other.test[0])
    assert torch.allclose(a.image, b.image, atol=1e-4)
    assert torch.allclose(a.depth * scale, b.depth, rtol=1e-3)


def test_the_centre_is_the_mean_of_the_training_cameras():
    scene = tiny_scene()
    model = EgoNeRF.from_scene(scene, SMALL)
    centers = torch.stack([view.center for view in scene.train])
    assert torch.allclose(model.centre, centers.mean(0))
    assert model.travel * model.unit == pytest.approx((centers - centers.mean(0)).norm(dim=-1).max().item())


def test_gradients_reach_every_parameter(generator):
    model = dense()
    model.trace(*rays(200, generator), generator).color.square().sum().backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name


def test_gradients_of_colours(generator):
    """float64, through absorption, shading and environment; the samples themselves are not differentiated."""
    model = dense().double()
    origins, directions = rays(2, generator)
    names = ["density.planes.2", "density.lines.2", "shader.basis", "shader.network.0.weight", "environment.emission"]
    own = dict(model.named_parameters())
    distances = model._sample(origins.double(), directions.double(), None)
    model._sample = lambda *_: distances  # type: ignore[method-assign]

    model.forward = lambda *args: model.trace(*args).color  # type: ignore[method-assign]

    def color(*values: torch.Tensor) -> torch.Tensor:
        parameters = {**own, **dict(zip(names, values, strict=True))}
        return torch.func.functional_call(model, parameters, (origins.double(), directions.double()))

    assert torch.autograd.gradcheck(color, tuple(own[name] for name in names), fast_mode=True)


@pytest.mark.parametrize(
    "changes, reason",
    [
        ({"polar_nodes": 9}, "polar_nodes is 9; it must be even"),
        ({"near": 0.0}, "near is 0.0"),
        ({"far": 0.06}, "far - near larger than first_radius"),
        ({"samples_at_once": 10}, "samples_at_once is 10, and a ray has 48; raise it"),
        ({"hidden": 0}, "hidden is 0; it must be at least 1"),
        ({"coarse_samples": 3}, "coarse_samples is 3 and fine_samples 24"),
    ],
)
def test_invalid_options_are_refused(changes, reason):
    with pytest.raises(ValueError, match=reason):
        replace(SMALL, **changes)


HEIGHT = 6


@pytest.fixture
def environment() -> EnvironmentMap:
    torch.manual_seed(1)
    return EnvironmentMap(HEIGHT).double()


def towards(z: torch.Tensor, azimuth: torch.Tensor) -> torch.Tensor:
    across = torch.sqrt(1 - z * z)
    return torch.stack((across * torch.cos(azimuth), across * torch.sin(azimuth), z), dim=-1)


def test_texel_centres_show_one_texel(environment):
    row, column = (part.flatten() for part in torch.meshgrid(torch.arange(6), torch.arange(12), indexing="ij"))
    z = (2 * row.double() + 1) / HEIGHT - 1
    seen = environment(towards(z, ((2 * column.double() + 1) / (2 * HEIGHT) - 1) * math.pi))
    assert torch.allclose(seen, torch.sigmoid(environment.emission[:, row, column].T))


def test_texels_have_equal_solid_angles(environment, generator):
    """Each texel's share in random directions, as the gradient of their sum tells it (before the sigmoid)."""
    count = 200_000
    directions = normalize(torch.randn(count, 3, dtype=torch.float64, generator=generator), dim=-1)
    with torch.no_grad():
        environment.emission.zero_()  # the sigmoid has slope 1/4 everywhere
    environment(directions).sum().backward()
    share = environment.emission.grad * 4 / count * (2 * HEIGHT**2)
    assert share.sum().item() / (2 * HEIGHT**2 * 3) == pytest.approx(1)
    assert (share - 1).abs().max() < 0.08  # 4 standard deviations of the sampling


def test_the_environment_is_continuous_at_180_degrees_and_finite_at_the_poles(environment):
    z = torch.linspace(-0.99, 0.99, 50, dtype=torch.float64)
    left, right = (environment(towards(z, torch.full_like(z, side * (math.pi - 1e-9)))) for side in (-1, 1))
    assert torch.allclose(left, right, atol=1e-7)
    seen = environment(torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], dtype=torch.float64))
    assert ((seen > 0) & (seen < 1)).all()


TINY: dict[str, Any] = {"width": 32, "train_views": 4, "test_views": 1, "samples": 1, "points": 600}


@pytest.mark.parametrize(("scene", "kind"), [("room", "indoor"), ("outdoor", "outdoor")])
def test_indoor_and_outdoor_scenes_are_distinguished_in_any_unit(tmp_path, monkeypatch, scene, kind):
    monkeypatch.setenv("PADGS_CACHE", str(tmp_path))
    found = [generate(SyntheticOptions(scene, **TINY, world_scale=scale)) for scale in (1.0, 100.0)]
    assert [surroundings_of(one) for one in found] == [kind, kind]
    assert cloud_reach(found[1]) == pytest.approx(cloud_reach(found[0]), rel=1e-3)


def test_outliers_do_not_change_the_surroundings():
    shell = normalize(torch.randn(1000, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    scene = tiny_scene()
    still: View = replace(scene.train[0], cam_from_world=torch.eye(4, dtype=torch.float64))
    for outliers, kind in ((30, "indoor"), (80, "outdoor")):
        points = shell.clone()
        points[:outliers] *= 50
        assert surroundings_of(replace(scene, train=(still,), points=points)) == kind


@pytest.mark.parametrize(("points", "why"), [(torch.zeros(0, 3), "is empty"), (torch.full((1, 3), torch.nan), "nan")])
def test_unusable_points_are_refused(points, why):
    with pytest.raises(ValueError, match=why):
        EgoNeRF.from_scene(replace(tiny_scene(), points=points), EgoNeRFOptions())


def test_given_constants_override_those_of_the_surroundings():
    small: dict[str, Any] = {"radial_nodes": 4, "polar_nodes": 4, "azimuth_nodes": 4, "environment_height": 4}
    chosen = EgoNeRF.from_scene(tiny_scene(), EgoNeRFOptions(**small))
    assert chosen.kind == surroundings_of(tiny_scene())
    options = EgoNeRFOptions(**small, surroundings="indoor", far=7.0)
    model = EgoNeRF.from_scene(tiny_scene(), options)
    assert model.kind == "indoor" and model.environment is None
    assert (model.constants.far, model.constants.density_shift) == (7.0, -8.0)
    with pytest.raises(ValueError, match="unknown surroundings 'cellar'; known: auto, outdoor, indoor"):
        EgoNeRFOptions(surroundings="cellar")
