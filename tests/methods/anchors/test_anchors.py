"""Anchors on their grid, and PaD-GS as seen from a camera."""

import json
import math
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from support.tiny_scene import tiny_scene

from padgs.geometry.camera import perspective
from padgs.methods.anchors import anchors
from padgs.native import cpu
from padgs.render import BACKENDS, RenderOptions, render
from padgs.scene import Scene, View
from padgs.training.loss import photometric_loss, pixel_weight

RELEASED = {  # of conf/method/padgs_release.yaml, what concerns the model
    "omega_axis": "world_z",
    "omega_input": "cos",
    "max_modulated_omega": 1 - 1e-4,
    "distance_unit": "world",
}
HEADS = ("opacity", "color", "covariance")
DTYPES = (torch.float64, torch.float32)


@pytest.fixture(scope="module")
def golden(shared):
    data = dict(np.load(shared / "golden" / "model_a.npz"))
    return {name: torch.from_numpy(value) for name, value in data.items() if name != "meta"} | {
        "meta": json.loads(str(data["meta"]))
    }


def golden_model(golden, dtype, **options) -> anchors.PaDGS:
    options = anchors.PaDGSOptions(**{"distance_unit": "world", "voxel_size": 0.1, **options})
    model = anchors.PaDGS(golden["anchors"].clone(), golden["log_scales"].clone(), options, voxel_size=0.1)
    with torch.no_grad():
        model.features.copy_(golden["features"])
        model.offsets.copy_(golden["offsets"])
        for head in HEADS:
            for name, weight in getattr(model.decoder, head).items():
                weight.copy_(golden[f"{head}_{name}"])
    return model.to(dtype)


def golden_view(golden) -> View:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = golden["R"], golden["t"]
    return View("golden", pose, golden["meta"]["width"], golden["meta"]["height"])


def assert_decoded(decoded: anchors.Decoded, golden, prefix: str, tolerance: float = 1e-5) -> None:
    selected = golden[f"{prefix}raw_opacities"] > 0
    assert torch.equal(decoded.raw_opacities.flatten() > 0, selected)
    assert torch.equal(decoded.slots, selected.nonzero()[:, 0])
    got = {
        "raw_opacities": decoded.raw_opacities.flatten()[selected],
        "opacities": decoded.gaussians.opacities,
        "means": decoded.gaussians.means,
        "scales": decoded.gaussians.scales,
        "quats": torch.nn.functional.normalize(decoded.gaussians.quats, dim=-1),
        "colors": decoded.gaussians.colors,
    }
    for name, value in got.items():
        if prefix + name in golden or name not in ("means", "quats"):
            expected = golden[prefix + name][selected].to(value.dtype)
            assert (value.detach() - expected).abs().max() <= tolerance, name


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("options", "prefix"), [({}, "expected_"), (RELEASED, "expected_released_")])
def test_golden_decode(golden, dtype, options, prefix):
    model, view = golden_model(golden, dtype, **options), golden_view(golden)
    assert_decoded(model.decode(view), golden, prefix)
    omega = model.seen_from(view)[2].clamp(max=model.options.max_modulated_omega)
    assert (omega - golden[f"{prefix}omega"]).abs().max() <= 1e-5


@pytest.mark.parametrize(
    ("backend", "dtype"), [("torch", torch.float64), *((backend, torch.float32) for backend in BACKENDS)]
)
def test_golden_image_and_gradients(golden, backend, dtype):
    if backend == "cpu" and not cpu.available():
        pytest.skip("the native CPU library is not built")
    if backend == "cuda" and "support.cuda_engine" not in sys.modules:
        pytest.skip("tests/render, which arranges for backend cuda, is not part of this run")
    meta = golden["meta"]
    model, view = golden_model(golden, dtype), golden_view(golden)
    options = RenderOptions(near=meta["near"], wrap=meta["wrap"], low_pass=meta["dilation"])
    drawn = render(
        model.decode(view).gaussians, view, options, background=golden["background"].to(dtype), backend=backend
    )
    assert (drawn.image.detach() - golden["expected_image"]).abs().max() <= 2e-5
    assert (drawn.transmittance.detach() - golden["expected_transmittance"]).abs().max() <= 2e-5

    weight = pixel_weight("solid_angle", meta["height"], dtype=dtype)
    loss = photometric_loss(drawn.image, golden["target"].to(dtype), weight, meta["lambda"])
    assert loss.item() == pytest.approx(meta["loss"], abs=1e-5)
    loss.backward()
    gradients = {name: parameter.grad for name, parameter in model.rows().items()}
    gradients |= {f"{head}_{name}": w.grad for head in HEADS for name, w in getattr(model.decoder, head).items()}
    for name, gradient in gradients.items():
        expected, valid = golden[f"grad_{name}"], golden[f"valid_{name}"]
        assert gradient is not None
        error = (gradient.flatten()[golden[f"grad_index_{name}"].long()] - expected).abs()[valid]
        assert valid.any() and error.max() <= 1e-3 * expected.abs().max(), name


def box_scene(*, scale: float = 1.0, count: int = 500) -> Scene:
    """Points on a sphere-like shell around three cameras; everything scaled by `scale`."""
    generator = torch.Generator().manual_seed(7)
    points = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=-1)
    points = points * (2 + torch.rand(count, 1, generator=generator, dtype=torch.float64))
    views = []
    for index in range(3):
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, 3] = scale * torch.tensor([0.3 * index, 0.05 * index, -0.2])
        views.append(View(f"v{index}", pose, 64, 32))
    colors = torch.zeros(count, 3, dtype=torch.uint8)
    return Scene("box", tuple(views), (), (scale * points).float(), colors, "0")


def perturbed(model: anchors.PaDGS) -> anchors.PaDGS:
    """The model as training might leave it: nothing at its initial value."""
    generator = torch.Generator().manual_seed(11)
    with torch.no_grad():
        for parameter in (model.features, model.offsets):
            parameter.copy_(torch.randn(parameter.shape, generator=generator, dtype=torch.float64))
    return model


def one_anchor(position, options=anchors.PaDGSOptions(), dtype=torch.float32) -> anchors.PaDGS:  # noqa: B008
    generator = torch.Generator().manual_seed(3)
    position = torch.tensor([position], dtype=torch.float32)
    model = anchors.PaDGS(position, torch.full((1, 6), -2.0), options, voxel_size=0.1, generator=generator)
    return perturbed(model).to(dtype)


def view_from(center, rotation=None) -> View:
    pose = torch.eye(4, dtype=torch.float64)
    if rotation is not None:
        pose[:3, :3] = torch.tensor(rotation, dtype=torch.float64)
    pose[:3, 3] = -pose[:3, :3] @ torch.tensor(center, dtype=torch.float64)
    return View("here", pose, 64, 32)


def test_number_of_network_inputs():
    assert anchors.PaDGSOptions().inputs == 37
    assert anchors.PaDGSOptions(use_distortion=False).inputs == 36
    assert anchors.PaDGSOptions(use_distortion=False, use_distance=False).inputs == 35


@pytest.mark.parametrize("use_distance", [True, False])
@pytest.mark.parametrize("use_distortion", [True, False])
def test_unused_inputs_change_nothing(use_distance, use_distortion):
    options = anchors.PaDGSOptions(use_distance=use_distance, use_distortion=use_distortion, tau=0.0)
    model = one_anchor([0.0, 0.0, 0.0], options)
    near, far = (model.decode(view_from(center)).raw_opacities for center in ([0.0, 0.0, -1.0], [0.0, 0.0, -5.0]))
    assert torch.equal(near, far) != use_distance
    level, rolled = (
        model.decode(view_from([1.0, 0.0, 0.0], rotation)).raw_opacities
        for rotation in (None, [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    )
    assert torch.equal(level, rolled) != use_distortion


def test_direction_points_from_camera_to_anchor_in_the_world_frame():
    quarter_turn = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]
    model = one_anchor([3.0, 4.0, 0.0])
    direction, distance, omega = model.seen_from(view_from([0.0, 0.0, 0.0], quarter_turn))
    assert torch.allclose(direction, torch.tensor([[0.6, 0.8, 0.0]]))
    assert distance.item() == pytest.approx(5.0) and omega.item() == pytest.approx(0.64)


def test_opacity_modulation_follows_the_latitude_in_the_camera():
    bright, dim = (
        one_anchor([0.0, -2.0, 0.0], anchors.PaDGSOptions(tau=tau, use_distortion=False)) for tau in (0.0, 0.9)
    )
    view = view_from([0.0, 0.0, 0.0])
    full, modulated = bright.decode(view).gaussians.opacities, dim.decode(view).gaussians.opacities
    assert len(full) > 0 and torch.allclose(modulated, 0.1 * full)
    tilted = view_from([0.0, 0.0, 0.0], [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # now on the horizon
    assert torch.allclose(dim.decode(tilted).gaussians.opacities, bright.decode(tilted).gaussians.opacities)


@pytest.mark.parametrize("overrides", [{}, RELEASED])
@pytest.mark.parametrize("position", [[0, 2, 0], [0, -2, 0], [0, 0, 2], [0, 0, -2], [0, 0, 0], [1e-9, 0, 0]])
def test_gradients_are_finite_at_the_poles_and_at_the_camera(overrides, position):
    model = one_anchor([float(x) for x in position], anchors.PaDGSOptions(**overrides))
    decoded = model.decode(view_from([0.0, 0.0, 0.0]))
    assert len(decoded.slots) > 0
    torch.cat([value.flatten() for value in vars(decoded.gaussians).values()]).sum().backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None
        assert torch.isfinite(parameter).all() and torch.isfinite(parameter.grad).all(), name


def test_positions_and_views_have_no_gradient():
    model = one_anchor([1.0, 1.0, 1.0])
    assert "positions" not in dict(model.named_parameters()) and "positions" in dict(model.named_buffers())
    assert not any(value.requires_grad for value in model.seen_from(view_from([0.0, 0.0, 0.0])))


def test_decoding_is_invariant_to_world_units():
    small, large = (perturbed(anchors.PaDGS.from_scene(box_scene(scale=scale))) for scale in (1.0, 100.0))
    assert large.voxel_size == pytest.approx(100 * small.voxel_size)
    assert torch.allclose(large.positions, 100 * small.positions, rtol=1e-6)
    seen = [model.decode(box_scene(scale=scale).train[1]) for model, scale in ((small, 1.0), (large, 100.0))]
    assert torch.equal(seen[0].slots, seen[1].slots)
    assert torch.allclose(seen[0].raw_opacities, seen[1].raw_opacities, atol=1e-5)
    first, second = seen[0].gaussians, seen[1].gaussians
    assert torch.allclose(100 * first.means, second.means, rtol=1e-4, atol=1e-3)
    assert torch.allclose(100 * first.scales, second.scales, rtol=1e-4)
    assert torch.allclose(first.opacities, second.opacities, atol=1e-5)


def test_seeds_determine_the_networks():
    first, same, other = (anchors.PaDGS.from_scene(box_scene(), seed=seed).decoder.opacity["w1"] for seed in (1, 1, 2))
    assert torch.equal(first, same) and not torch.equal(first, other)


def test_gradients_match_finite_differences():
    model = perturbed(
        anchors.PaDGS.from_scene(box_scene(count=4), anchors.PaDGSOptions(features=3, offsets=2, hidden=4))
    ).double()
    view = box_scene().train[1]
    names = [name for name, _ in model.named_parameters()]

    def outputs(*parameters):
        decoded = torch.func.functional_call(
            _Decode(model), dict(zip([f"model.{n}" for n in names], parameters, strict=True)), view
        )
        return decoded.means, decoded.scales, decoded.quats, decoded.opacities, decoded.colors

    parameters = tuple(parameter.detach().clone().requires_grad_() for parameter in model.parameters())
    assert torch.autograd.gradcheck(outputs, parameters)


class _Decode(torch.nn.Module):
    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, view):
        return self.model.decode(view).gaussians


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"omega_axis": "up"}, "omega_axis 'up'; known: camera_y, world_z"),
        ({"omega_input": "sin"}, "known: sin2, cos"),
        ({"distance_unit": "metre"}, "known: scene, world"),
        ({"voxel_size": "small"}, "known: auto"),
        ({"tau": 1.5}, r"tau is 1.5; it must be in \[0, 1\]"),
        ({"offsets": 0}, "offsets is 0"),
        ({"max_modulated_omega": -1.0}, "max_modulated_omega is -1.0"),
    ],
)
def test_invalid_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        anchors.PaDGSOptions(**options)


def test_anchors_are_the_distinct_nearest_vertices():
    points = torch.tensor([[0.24, 0.0, 0.0], [0.26, 0.0, 0.0], [-0.26, 0.6, 0.0], [0.2, 0.1, -0.1]])
    expected = torch.tensor([[-0.5, 0.5, 0.0], [0.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
    assert torch.equal(anchors.anchors_from_points(points, 0.5), expected)
    assert anchors.cells_from_points(torch.tensor([[0.5, 1.5, -0.5]]), 1.0).tolist() == [[0, 2, 0]], "halves go to even"


@pytest.mark.parametrize("size", [0.001, 0.037, 5.0])
def test_cells_survive_conversion_to_float32_positions(size, generator):
    cells = torch.randint(-(2**20), 2**20, (2000, 3), generator=generator)
    assert torch.equal(anchors.cells_from_points(anchors.points_from_cells(cells, size), size), cells)


@pytest.mark.parametrize("spread", [3, 2**40])  # narrow: digits of one number; wide: more than 64 bits
def test_unique_and_occupied_cells_match_python_sets(spread, generator):
    cells = torch.randint(-spread, spread, (300, 3), generator=generator)
    cells = torch.cat((cells, cells[::3], torch.tensor([[-spread] * 3, [spread] * 3])))
    unique, inverse = anchors.unique_cells(cells)
    assert [tuple(row) for row in unique.tolist()] == sorted({tuple(row) for row in cells.tolist()})
    assert torch.equal(unique[inverse], cells)
    assert len(anchors.cell_keys(cells).unique()) == len(unique)
    by = torch.randint(-spread, spread, (200, 3), generator=generator)
    cells = torch.cat((torch.randint(-spread, spread, (200, 3), generator=generator), by[::7]))
    there = {tuple(row) for row in by.tolist()}
    assert anchors.occupied(cells, by).tolist() == [tuple(row) in there for row in cells.tolist()]


def test_empty_sets_of_cells():
    nothing = torch.zeros(0, 3, dtype=torch.int64)
    assert [len(part) for part in anchors.unique_cells(nothing)] == [0, 0]
    assert anchors.occupied(nothing, torch.ones(2, 3, dtype=torch.int64)).shape == (0,)
    assert anchors.occupied(torch.ones(2, 3, dtype=torch.int64), nothing).tolist() == [False, False]


def test_initial_scale_is_the_root_mean_square_of_three_distances():
    positions = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [0, 2.0, 0], [0, 0, 3.0], [100.0, 0, 0]])
    log_scales = anchors.initial_log_scales(positions, 1.0)
    assert log_scales.shape == (5, 6) and log_scales.dtype == torch.float32
    assert torch.allclose(log_scales[0], torch.tensor(0.5 * math.log((1 + 4 + 9) / 3)))
    assert anchors.initial_log_scales(torch.zeros(1, 3), 0.25).eq(math.log(0.25)).all(), (
        "an anchor alone has the voxel size"
    )
    two = anchors.initial_log_scales(torch.tensor([[0.0, 0, 0], [0, 4.0, 0]]), 1.0)
    assert torch.allclose(two, torch.tensor(math.log(4.0)))


@pytest.mark.parametrize("scale", [0.01, 1.0, 100.0])
def test_automatic_voxel_size(scale):
    points = scale * torch.tensor([[0.0, 0.0, 5.0], [0.0, 5.0, 0.0], [-5.0, 0.0, 0.0]])
    view = View("v", torch.eye(4, dtype=torch.float64), 400, 200)
    scene = Scene("s", (view,), (), points, torch.zeros(3, 3, dtype=torch.uint8), "0")
    expected, options = pytest.approx(0.25 * math.pi / 200 * 5.0 * scale), anchors.PaDGSOptions(voxel_pixels=0.25)
    assert anchors.PaDGS.from_scene(scene, options).voxel_size == expected
    photograph = replace(view, width=3000, height=2000, lens=perspective(3000, 2000, 45.0))
    mixed = replace(scene, train=(view, photograph))
    assert anchors.PaDGS.from_scene(mixed, options).voxel_size == expected, "of panoramas"


def test_invalid_clouds_are_refused():
    with pytest.raises(ValueError, match="point cloud is empty"):
        anchors.anchors_from_points(torch.zeros(0, 3), 0.1)
    with pytest.raises(ValueError, match="point 1 of the cloud is"):
        anchors.anchors_from_points(torch.tensor([[0.0, 0, 0], [0, float("nan"), 0]]), 0.1)
    with pytest.raises(ValueError, match="voxel_size is 1e-18, but points are 2 world units from the origin"):
        anchors.anchors_from_points(torch.tensor([[0.0, -2, 0]]), 1e-18)


def test_other_cameras_see_the_distortion_of_panoramas_of_their_place():
    """A pinhole that looks down sees at its nadir what a level panorama sees there (Eq. 12)."""
    positions = torch.tensor([[0.0, 2.0, 0.1], [0.5, 0.0, 1.0], [1.0, -1.0, 0.0]])
    model = anchors.PaDGS(positions, torch.zeros(3, 6), voxel_size=0.1, axis=[0.0, 1.0, 0.0])
    level, down = torch.eye(4), torch.eye(4)
    down[:3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    panorama, pinhole = View("p", level, 16, 8), View("q", down, 8, 8, lens=perspective(8, 8, 90.0))
    expected = model.seen_from(panorama)[2]
    assert expected[0] > 0.99 and torch.allclose(model.seen_from(pinhole)[2], expected)
    assert not torch.allclose(model.seen_from(replace(pinhole, lens=None, width=16))[2], expected), "tilted panorama"
    turned = anchors.mean_axis(tiny_scene())
    assert turned is not None and math.hypot(*turned) == pytest.approx(1)
