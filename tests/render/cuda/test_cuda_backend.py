"""The GPU backend where it differs from the others: strips, long lists, scheduling, errors. On the GPU or emulated."""

import ctypes
import warnings
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import pytest
import torch
from support import cuda_engine
from support import render_cases as cases
from torch import Tensor

from padgs import render as package
from padgs.gaussians import Gaussians
from padgs.native import cuda, loading
from padgs.render import Rendering, RenderOptions, render
from padgs.render.backends import cuda as cuda_backend
from padgs.render.backends import native as native_backend
from padgs.render.leave_one_out import leave_one_out
from padgs.training.health import is_out_of_memory

pytestmark = [*cuda_engine.marks()]


def drawn(
    gaussians: Gaussians,
    size: tuple[int, int],
    options: RenderOptions,
    *,
    backend: str = "cuda",
    lens: str = "panorama",
    weights: torch.dtype | None = None,
    outputs: tuple[str, ...] = ("image", "transmittance", "depth"),
) -> tuple[Rendering, dict[str, Tensor]]:
    """Return a rendering in a random pose, and gradients of randomly weighted outputs."""
    generator = torch.Generator().manual_seed(5)
    inputs = cases.leaves(gaussians, torch.float32)
    pose = cases.random_pose(generator, shift=0.1).float().requires_grad_()
    rendering = render(inputs, cases.view_of(cases.camera_of(lens, *size), pose), options, backend=backend)
    weighed = (getattr(rendering, name) for name in outputs)
    sum((out * torch.randn(out.shape, generator=generator, dtype=weights)).sum() for out in weighed).backward()
    return rendering, {**{name: getattr(inputs, name).grad for name in cases.INPUTS}, "pose": pose.grad}


def crowd(count: int, generator: torch.Generator) -> Gaussians:
    """Return faint Gaussians whose lists are longer than the batches and buckets of kernels."""
    gaussians = cases.mixture(count // 4, generator, ("ordinary", "polar", "pole", "seam"))
    return Gaussians(**{**vars(gaussians), "opacities": 0.1 * gaussians.opacities})


@pytest.mark.parametrize("blending", ["sorted", "hybrid"])
@pytest.mark.parametrize("projection", ["erp", "tangent", "ray"])
def test_long_lists(projection: str, blending: str, generator: torch.Generator):
    gaussians = crowd(1200, generator)
    options = RenderOptions(projection, low_pass_kind="angular", **cases.blended(blending, 4))
    expected, expected_gradients = drawn(gaussians, (72, 36), options, backend="cpu")
    actual, gradients = drawn(gaussians, (72, 36), options)
    assert actual.counters["instances"] > 8 * 256
    flipped = 2e-3  # an alpha that rounding moves across 1/255 changes a pixel by so much
    assert ((actual.image - expected.image).abs().amax(-1) > 2e-5).double().mean() < 0.02
    assert (actual.image - expected.image).abs().max() < flipped
    for name, gradient in expected_gradients.items():
        if name != "pose":
            assert cases.row_error(gradients[name], gradient) < 0.05, name
            assert (gradients[name] - gradient).norm() < 5e-3 * gradient.norm(), name


def test_leave_one_out_of_long_lists_is_deterministic(generator, monkeypatch):
    gaussians, options = crowd(1200, generator), RenderOptions("ray", low_pass=0.1)
    gaussians = Gaussians(**{name: tensor.float() for name, tensor in vars(gaussians).items()})
    view, target, weight = cases.view_of(cases.camera_of("panorama", 72, 36)), torch.rand(36, 72, 3), torch.rand(36, 72)
    expected, actual = (
        leave_one_out(gaussians, view, target, weight, options, backend=backend) for backend in ("cpu", "cuda")
    )
    for name in ("error", "change", "contribution"):
        true, found = getattr(expected, name), getattr(actual, name)
        assert ((found - true).abs() > 1e-3 * true.abs() + 1e-8).double().mean() < 0.01, name  # at the edge of 1/255
    assert (actual.peak - expected.peak).abs().max() < 1 / 250
    if not cuda_engine.ON_GPU:
        monkeypatch.setenv("PADGS_EMULATION_SEED", "1")
    again = leave_one_out(gaussians, view, target, weight, options, backend="cuda")
    assert all(torch.equal(tensor, getattr(actual, name)) for name, tensor in vars(again).items())


@pytest.mark.parametrize("projection", ["erp", "ray"])
def test_core_sizes(projection: str, generator: torch.Generator):
    """Core sizes around those that kernels are compiled for; some pixels have more fragments."""
    gaussians = cases.gaussians_of("ordinary", 300, generator)
    ahead = gaussians.means.abs() * torch.tensor([0.1, 0.1, 1.0]) + torch.tensor([0.0, 0.0, 2.0])
    broad = {"scales": 0.4 + gaussians.scales, "opacities": torch.full((300,), 0.08, dtype=torch.float64)}
    gaussians, images = Gaussians(**{**vars(gaussians), "means": ahead.float().double(), **broad}), []
    for size in (1, 16, 17, 64, 65, 256):
        options = RenderOptions(projection, blending="hybrid", core_size=size)
        expected, expected_gradients = drawn(gaussians, (36, 18), options, backend="cpu")
        actual, gradients = drawn(gaussians, (36, 18), options)
        assert ((actual.image - expected.image).abs().amax(-1) > 2e-5).double().mean() < 0.05
        for name, gradient in expected_gradients.items():
            assert (gradients[name] - gradient).norm() < 5e-3 * gradient.norm(), name
        images.append(actual.image.detach())
    assert all((one - other).abs().max() > 1e-4 for one, other in pairwise(images))


@pytest.mark.parametrize("blending", ["sorted", "hybrid"])
def test_strips_change_nothing(blending: str, generator: torch.Generator):
    gaussians, options = crowd(200, generator), RenderOptions(**cases.blended(blending, 3))
    whole, whole_gradients = drawn(gaussians, (131, 77), options)
    parts, parts_gradients = drawn(gaussians, (131, 77), replace(options, max_instances=300))
    for name in ("image", "transmittance", "depth", "visible"):
        assert torch.equal(getattr(parts, name), getattr(whole, name)), name
    assert dict(parts.counters) == dict(whole.counters)
    for name, gradient in whole_gradients.items():
        torch.testing.assert_close(parts_gradients[name], gradient, rtol=1e-4, atol=1e-4 * gradient.abs().max().item())


@pytest.mark.parametrize("blending", ["sorted", "hybrid"])
@pytest.mark.parametrize(("projection", "lens"), [("erp", "panorama"), ("ray", "panorama"), ("tangent", "fisheye")])
def test_results_do_not_depend_on_which_thread_runs_first(
    projection, lens, blending, generator, monkeypatch: pytest.MonkeyPatch
):
    gaussians, options = crowd(400, generator), RenderOptions(projection, **cases.blended(blending, 3))
    usual = drawn(gaussians, (40, 20), options, lens=lens)
    for seed in range(3):  # of the order in which the emulation runs threads; a GPU just repeats
        monkeypatch.setenv("PADGS_EMULATION_SEED", str(seed))
        assert_same_bits(drawn(gaussians, (40, 20), options, lens=lens), usual, ("image", "transmittance", "depth"))


def assert_same_bits(actual, expected, outputs: tuple[str, ...]) -> None:
    for name in outputs:
        assert torch.equal(getattr(actual[0], name), getattr(expected[0], name)), name
    assert dict(actual[0].counters) == dict(expected[0].counters)
    for name, gradient in expected[1].items():
        assert torch.equal(actual[1][name], gradient), name


@pytest.mark.skipif(cuda_engine.ON_GPU or not cuda_engine.FUSES, reason="about what compilers may do, on the host")
@pytest.mark.parametrize(
    ("projection", "lens"), [("erp", "panorama"), ("ray", "panorama"), ("tangent", "fisheye"), ("pinhole", "pinhole")]
)
def test_fused_multiply_add_changes_no_decision(projection, lens, generator, monkeypatch):
    """Forward and backward passes of different builds must agree on every pair to the last bit."""
    gaussians, options = crowd(400, generator), RenderOptions(projection)
    call = cuda.call

    def forward_fused(name: str, where, *arguments) -> None:
        if name != "padgs_cuda_blend":
            return call(name, where, *arguments)
        return cuda.raise_for(
            cuda_engine.fused_library().padgs_cuda_blend(*map(ctypes.byref, (where, *arguments))), name
        )

    monkeypatch.setattr(cuda, "call", forward_fused)
    fused = drawn(gaussians, (72, 36), options, lens=lens, outputs=("image", "transmittance"))
    monkeypatch.setattr(cuda, "call", call)
    usual = drawn(gaussians, (72, 36), options, lens=lens, outputs=("image", "transmittance"))
    assert_same_bits(fused, usual, ("transmittance",))
    assert not torch.equal(fused[0].image, usual[0].image)  # whose sums the compiler may round as it likes
    torch.testing.assert_close(fused[0].image, usual[0].image, rtol=1e-5, atol=1e-6)


@pytest.fixture(autouse=True)
def no_image_before(monkeypatch: pytest.MonkeyPatch):
    """Forget the capacities of images of earlier tests."""
    monkeypatch.setattr(cuda_backend, "_capacities", {})


def recorded(monkeypatch: pytest.MonkeyPatch, function: str, read) -> list:
    """Record `read(arguments)` of each call of a function of the library."""
    found, call = [], cuda.call

    def spy(name: str, where, *arguments) -> None:
        if name == function:
            found.append(read(arguments[0]))
        call(name, where, *arguments)

    monkeypatch.setattr(cuda, "call", spy)
    return found


@pytest.mark.parametrize("blending", ["sorted", "hybrid"])
def test_capacity_of_the_last_image_changes_nothing(
    blending: str, generator: torch.Generator, monkeypatch: pytest.MonkeyPatch
):
    gaussians, options = crowd(200, generator), RenderOptions("ray", **cases.blended(blending, 3))
    capacities = recorded(monkeypatch, "padgs_cuda_bin", lambda arguments: arguments.sort.count)
    usual = drawn(gaussians, (72, 36), options)
    count = usual[0].counters["instances"]
    outputs = ("image", "transmittance", "depth", "visible")
    assert_same_bits(drawn(gaussians, (72, 36), options), usual, outputs)
    assert capacities == [count, int(1.3 * count) + 1]
    for (_, *size), capacity in list(cuda_backend._capacities.items()):
        assert size == [72, 36] and capacity == int(1.3 * count) + 1
    cuda_backend._capacities = dict.fromkeys(cuda_backend._capacities, count - 1)
    assert_same_bits(drawn(gaussians, (72, 36), options), usual, outputs)
    assert capacities[2:] == [count - 1, count]  # drawn again
    assert_same_bits(drawn(gaussians, (72, 36), replace(options, max_instances=count)), usual, outputs)
    assert capacities[4:] == [count]  # the capacity would be for more than may be
    assert {*cuda_backend._capacities.values()} == {count}  # the next has as much as may be


def test_faces_of_a_cubemap_share_a_capacity_for_the_largest(generator, monkeypatch: pytest.MonkeyPatch):
    options, many = RenderOptions("ray"), crowd(200, generator)
    for _ in range(2):
        bins = recorded(monkeypatch, "padgs_cuda_bin", lambda arguments: arguments.sort.count)
        drawn(many, (72, 36), options)
        for _ in range(5):
            drawn(many.chosen(slice(10)), (72, 36), options)
    assert len(bins) == 6, "no face is drawn twice"


@pytest.mark.parametrize("blending", ["sorted", "hybrid"])
@pytest.mark.parametrize("lens", ["panorama", "pinhole"])
def test_counters_equal_those_of_the_cpu(lens: str, blending: str, generator: torch.Generator):
    gaussians, options = (
        cases.gaussians_of("ordinary", 40, generator),
        RenderOptions("ray", **cases.blended(blending, 2)),
    )
    expected, actual = (drawn(gaussians, (72, 36), options, backend=name, lens=lens)[0] for name in ("cpu", "cuda"))
    assert set(actual.counters) == set(expected.counters) and len(actual.counters) == 5
    for name in ("gaussians", "visible", "contributing"):
        assert actual.counters[name] == expected.counters[name]
    assert (actual.counters["instances"] > expected.counters["instances"]) == (lens == "panorama")  # of narrower tiles
    assert 0 < actual.counters["contributing"] <= actual.counters["evaluated"]
    with pytest.raises(KeyError):
        actual.counters["pixels"]


def test_cores_are_kept_only_with_gradients(generator: torch.Generator, monkeypatch: pytest.MonkeyPatch):
    kept = recorded(monkeypatch, "padgs_cuda_blend", lambda a: a.core is not None and a.tails is not None)
    inputs = cases.leaves(cases.gaussians_of("ordinary", 5, generator), torch.float32)
    view, options = cases.view_of(cases.camera_of("panorama", 32, 16)), RenderOptions(blending="hybrid")
    images = [render(inputs, view, options, backend="cuda").image]
    with torch.no_grad():
        images.append(render(inputs, view, options, backend="cuda").image)
    constant = Gaussians(**{name: tensor.detach() for name, tensor in vars(inputs).items()})
    images.append(render(constant, view, options, backend="cuda").image)
    assert kept == [True, False, False]
    assert torch.equal(images[0], images[1]) and torch.equal(images[0], images[2])


def test_other_dtypes_and_devices_are_refused(monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(ValueError, match="backend cuda takes float32 tensors on a GPU, got torch.float64 on "):
        cuda_backend._Image.check(torch.zeros(1, 3, dtype=torch.float64))
    monkeypatch.setattr(cuda, "device_type", lambda: "cuda")
    where = "" if torch.cuda.is_available() else r" \(torch finds no GPU with a driver here\)"
    with pytest.raises(ValueError, match=f"got torch.float32 on cpu{where}; convert them, or use backend=auto"):
        cuda_backend._Image.check(torch.zeros(1, 3))


def test_more_instances_than_a_list_can_hold_are_refused(generator, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(cuda_backend, "MAX_INSTANCES", 10)
    message = r"one row of tiles has \d+ \(Gaussian, tile\) instances; a list holds at most 10. Draw fewer"
    with pytest.raises(ValueError, match=message):
        drawn(crowd(200, generator), (72, 36), RenderOptions())


def test_cuda_errors():
    cuda.raise_for(0, "padgs_cuda_sort")
    with pytest.raises(RuntimeError, match="padgs_cuda_sort: CUDA error 700, ") as error:
        cuda.raise_for(700, "padgs_cuda_sort")
    assert not is_out_of_memory(error.value)
    with pytest.raises(torch.cuda.OutOfMemoryError, match="padgs_cuda_sort: CUDA error 2, ") as error:
        cuda.raise_for(2, "padgs_cuda_sort")
    assert is_out_of_memory(error.value)


def test_unsupported_gpus_are_named(monkeypatch: pytest.MonkeyPatch):
    fake = SimpleNamespace(padgs_cuda_check=lambda _: 209, padgs_cuda_architectures=lambda: b"80 90")
    monkeypatch.setattr(cuda, "library", lambda: fake)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda _: (7, 5))
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda _: "Tesla T4")
    with pytest.raises(
        RuntimeError, match="compiled for compute capabilities 80 90; Tesla T4 has 75. .*ARCHITECTURES=75"
    ):
        cuda.check_device.__wrapped__(0)
    monkeypatch.setattr(cuda, "check_device", cuda.check_device.__wrapped__)
    with pytest.raises(RuntimeError, match="Tesla T4"):  # or there is no way out by backend=torch
        cuda.require(torch.device("cuda", 0))


@pytest.fixture
def looked_for_anew(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Clear the caches of the library before and after the test."""
    found = cuda.available
    monkeypatch.setattr(cuda, "library", cuda_engine.real_library.__wrapped__)
    found.cache_clear()
    package._warn_missing_library.cache_clear()
    yield
    found.cache_clear()


@pytest.mark.usefixtures("looked_for_anew")
def test_old_drivers_warn_and_use_torch(monkeypatch: pytest.MonkeyPatch):
    for driver, built_with in ((0, 13000), (13000, 13020), (13020, 13000), (0, 0)):
        cuda.refuse_old_driver(versions_of(driver, built_with))
    monkeypatch.setattr(cuda, "find_library", lambda *_: None)
    monkeypatch.setattr(cuda, "declare", lambda *_: versions_of(12080, 13000))
    means = SimpleNamespace(device=torch.device("cuda"), dtype=torch.float32)
    with pytest.warns(UserWarning, match=r"compiled by CUDA 13\.0, but the driver supports CUDA 12\.8; update"):
        assert package.resolve_backend("auto", means) == "torch"


def versions_of(driver: int, built_with: int) -> SimpleNamespace:
    def answer(first, second) -> None:
        first._obj.value, second._obj.value = driver, built_with

    return SimpleNamespace(padgs_cuda_versions=answer)


@pytest.mark.parametrize("blending", ["sorted", "hybrid"])
@pytest.mark.parametrize("lens", ["panorama", "pinhole"])
def test_the_default_dtype_of_torch_changes_nothing(lens: str, blending: str, generator: torch.Generator):
    gaussians, options = crowd(40, generator), RenderOptions("ray", **cases.blended(blending, 3))
    native_backend._formula_rays.cache_clear()
    usual = drawn(gaussians, (40, 20), options, lens=lens)
    native_backend._formula_rays.cache_clear()
    weights = torch.get_default_dtype()
    try:
        torch.set_default_dtype(torch.float64)
        doubled = drawn(gaussians, (40, 20), options, lens=lens, weights=weights)
    finally:
        torch.set_default_dtype(weights)
        native_backend._formula_rays.cache_clear()
    assert torch.equal(usual[0].image, doubled[0].image)
    assert all(torch.equal(gradient, doubled[1][name]) for name, gradient in usual[1].items())


@pytest.mark.usefixtures("looked_for_anew")
def test_missing_library_warns_and_uses_torch(tmp_path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("PADGS_LIBRARY_DIR", str(tmp_path))
    monkeypatch.setattr(loading, "_package_folders", lambda: [str(tmp_path)])
    means = SimpleNamespace(device=torch.device("cuda"), dtype=torch.float32)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert package.resolve_backend("auto", means) == "torch"
    assert "slower than cuda: libpadgs_cuda.so not found in" in str(caught[0].message) and "nvcc" in str(
        caught[0].message
    )
    monkeypatch.setattr(cuda, "require", lambda device: None)
    assert package.resolve_backend("auto", means) == "cuda"
    assert package.resolve_backend("auto", SimpleNamespace(device=torch.device("cuda"), dtype=torch.float64)) == "torch"
