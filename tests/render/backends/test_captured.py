"""Frames with a given capacity against ordinary frames; recorded on a GPU, run again without one."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from support import cuda_engine
from support.render_cases import INPUTS, camera_of, mixture, random_pose, view_of
from torch.utils._python_dispatch import TorchDispatchMode

from padgs.gaussians import Gaussians
from padgs.methods.anchors.anchors import PaDGS, PaDGSOptions
from padgs.native import cuda
from padgs.render import Rendering, RenderOptions
from padgs.render.backends import captured
from padgs.render.backends import cuda as cuda_backend
from padgs.render.backends.captured import CapturedRender
from padgs.render.backends.cuda import DeviceProjected, DeviceStrip
from padgs.render.backends.native import native_camera
from padgs.render.contract import Request
from padgs.scene import View

pytestmark = [*cuda_engine.marks()]
captured_for_real = captured.captured
DEVICE = torch.device("cuda" if cuda_engine.ON_GPU else "cpu")


@pytest.fixture(autouse=True)
def recorded(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Count recordings; without a GPU, a replay runs the recorded function again."""
    times, original = [], captured.captured

    def counted(record, device):
        times.append(1)
        return original(record, device) if cuda_engine.ON_GPU else record

    monkeypatch.setattr(captured, "captured", counted)
    return times


@pytest.fixture
def dirty_memory(monkeypatch: pytest.MonkeyPatch):
    """Fill uninitialised memory with the largest numbers, so that reading it is detected."""
    monkeypatch.setenv("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # else products on a GPU warn, which is an error here
    torch.use_deterministic_algorithms(True, warn_only=True)
    try:
        assert torch.empty(1, dtype=torch.int32, device=DEVICE).item() == 2**31 - 1
        yield
    finally:
        torch.use_deterministic_algorithms(False)


def scene_of(generator: torch.Generator, count: int = 40) -> Gaussians:
    return mixture(count // 4, generator, ("ordinary", "polar", "seam", "needle")).to(DEVICE, torch.float32)


def ordinary(gaussians: Gaussians, view: View, options: RenderOptions) -> Rendering:
    background = torch.zeros(3, device=DEVICE)
    pose = view.cam_from_world.to(DEVICE, torch.float32)
    return cuda_backend.rasterize(Request(gaussians, pose, view.camera, options, background))


def assert_same(actual: Rendering, expected: Rendering) -> None:
    for name in ("image", "transmittance", "depth", "visible"):
        assert torch.equal(getattr(actual, name), getattr(expected, name)), name
    assert dict(actual.counters) == dict(expected.counters)


@pytest.mark.usefixtures("dirty_memory")
@pytest.mark.parametrize(
    ("options", "lens"),
    [
        (RenderOptions(), "panorama"),
        (RenderOptions("tangent"), "panorama"),
        (RenderOptions("ray"), "fisheye"),
        (RenderOptions("pinhole"), "pinhole"),
        (RenderOptions("ray", blending="hybrid", core_size=3), "panorama"),
    ],
    ids=lambda value: f"{value.projection}-{value.blending}" if isinstance(value, RenderOptions) else value,
)
def test_captured_frames_equal_ordinary_frames(options, lens, generator: torch.Generator, recorded: list[int]):
    gaussians, view = scene_of(generator), view_of(camera_of(lens, 72, 36), random_pose(generator, shift=0.1))
    draw = CapturedRender(lambda _: gaussians, view, options, capacity=20_000)
    frames = []
    for _ in range(3):
        pose = random_pose(generator, shift=0.1)
        frames.append((draw(pose), ordinary(gaussians, view.at(pose), options)))
    for actual, expected in frames:  # none was overwritten by a later one
        assert_same(actual, expected)
    counts = {expected.counters["instances"] for _, expected in frames}
    assert len(counts) > 1 or lens == "fisheye"  # which may look anywhere: all tiles list all Gaussians
    assert not torch.equal(frames[0][0].image, frames[1][0].image)
    assert len(recorded) == 1 and draw.capacity == 20_000


@pytest.mark.usefixtures("dirty_memory")
@pytest.mark.parametrize("missing", [1, 10, "nearly all", 0])
def test_too_small_capacity_is_increased(missing: int | str, generator: torch.Generator, recorded: list[int]):
    gaussians, view = scene_of(generator), view_of(camera_of("panorama", 72, 36))
    expected = ordinary(gaussians, view, RenderOptions())
    instances = expected.counters["instances"]
    capacity = 1 if isinstance(missing, str) else instances - missing
    assert CapturedRender(lambda _: gaussians, view).capacity == int(1.5 * instances) + 1
    draw = CapturedRender(lambda _: gaussians, view, capacity=capacity)
    assert_same(draw(view.cam_from_world), expected)
    assert len(recorded) == (1 if capacity == instances else 2)
    assert draw.capacity == (instances if capacity == instances else int(1.5 * instances) + 1)
    assert_same(draw(view.cam_from_world), expected)
    assert len(recorded) < 3


def test_poses_and_backgrounds_need_not_be_contiguous(generator: torch.Generator):
    gaussians, view = scene_of(generator), view_of(camera_of("panorama", 40, 20), random_pose(generator, shift=1))
    transposed, background = view.at(view.cam_from_world.T.contiguous().T), torch.ones(1, device=DEVICE).expand(3)
    draw = CapturedRender(lambda _: gaussians, transposed, background=background)
    expected = CapturedRender(lambda _: gaussians, view, background=torch.ones(3, device=DEVICE))
    assert_same(draw(transposed.cam_from_world), expected(view.cam_from_world))


def test_show_is_recorded_and_tensors_are_references(generator: torch.Generator):
    gaussians, view = scene_of(generator), view_of(camera_of("panorama", 40, 20), random_pose(generator))

    def shown(view: View) -> Gaussians:  # as colours that depend on where the camera is
        return replace(gaussians, colors=gaussians.colors * view.center.to(DEVICE, torch.float32).abs())

    background = torch.zeros(3, device=DEVICE)
    draw = CapturedRender(shown, view, background=background)
    for _ in range(2):
        pose = random_pose(generator, shift=1)
        assert_same(draw(pose), ordinary(shown(view.at(pose)), view.at(pose), RenderOptions()))
        gaussians.means[:] = gaussians.means.flip(0)
    background += 1
    bright = draw(pose)
    assert (bright.image - bright.transmittance[..., None] >= 0).all() and bright.image.max() > 0.9


@pytest.mark.usefixtures("dirty_memory")
@pytest.mark.parametrize("omega_axis", ["camera_y", "world_z"])
def test_anchors_are_decoded_within_the_recording(omega_axis: str, generator: torch.Generator, recorded: list[int]):
    positions = 4 * torch.randn(30, 3, generator=generator)
    options = PaDGSOptions(omega_axis=omega_axis)
    model = PaDGS(positions, torch.full((30, 6), -1.0), options, voxel_size=0.1, generator=generator).to(DEVICE)
    with torch.no_grad():
        for parameter in (model.features, model.offsets):
            parameter.copy_(torch.randn(parameter.shape, generator=generator))
        view = view_of(camera_of("panorama", 72, 36))
        draw = CapturedRender(model.show, view, capacity=10_000)
        counts = set()
        for _ in range(2):
            pose = random_pose(generator, shift=1)
            shown = model.show(view.at(pose))
            selected = int((shown.opacities > 0).sum())
            exact = Gaussians(**{name: getattr(shown, name)[:selected] for name in INPUTS})
            actual, expected = draw(pose), ordinary(exact, view.at(pose), RenderOptions())
            for name in ("image", "transmittance", "depth"):
                assert torch.equal(getattr(actual, name), getattr(expected, name)), name
            assert torch.equal(actual.visible[:selected], expected.visible) and not actual.visible[selected:].any()
            counts.add(selected)
    assert len(counts) == 2 and 0 < max(counts) < 300 and len(recorded) == 1


class NothingIsRead(TorchDispatchMode):
    """Refuse operations that make the host wait, as a real recording does."""

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        name = function._schema.name.split("::")[1]
        assert name not in ("_local_scalar_dense", "nonzero", "masked_select", "equal", "lift_fresh"), name
        return function(*args, **(kwargs or {}))


@pytest.mark.parametrize(
    "options", [RenderOptions(), RenderOptions("ray", blending="hybrid")], ids=lambda o: o.blending
)
def test_recordings_do_not_wait_for_the_device(options, generator: torch.Generator, monkeypatch: pytest.MonkeyPatch):
    view = view_of(camera_of("fisheye" if options.projection == "ray" else "panorama", 40, 20))
    model = PaDGS(
        torch.randn(30, 3, generator=generator),
        torch.full((30, 6), -1.0),
        PaDGSOptions(omega_axis="world_z"),
        voxel_size=0.1,
        generator=generator,
    ).to(DEVICE)
    draw = CapturedRender(model.show, view, options)
    draw(view.cam_from_world)  # what is kept for a camera is there

    def refuse(_):
        raise AssertionError("tolist")

    with monkeypatch.context() as patch, NothingIsRead(), torch.no_grad():
        patch.setattr(torch.Tensor, "tolist", refuse)
        assert draw._record().image.shape == (20, 40, 3)
    with pytest.raises(AssertionError), NothingIsRead():
        torch.ones(1).sum().item()


def test_recording_uses_its_own_stream_and_thread_local_mode(monkeypatch: pytest.MonkeyPatch):
    """The default stream belongs to one device, and the default mode ends recordings when any thread allocates."""
    how, inside = [], []

    def graph(graph, **options):
        how.append(options)
        return contextlib.nullcontext()

    streams = [SimpleNamespace(wait_stream=lambda other: None) for _ in range(2)]
    names = {"CUDAGraph": SimpleNamespace, "Stream": lambda: streams[0], "current_stream": lambda: streams[1]}
    names |= {"device": contextlib.nullcontext, "stream": lambda stream: contextlib.nullcontext(), "graph": graph}
    for name, fake in names.items():
        monkeypatch.setattr(torch.cuda, name, fake)
    captured_for_real(lambda: inside.append(len(how)), torch.device("cuda", 1))
    assert inside == [0, 1] and how == [{"stream": streams[0], "capture_error_mode": "thread_local"}]


def test_empty_frames(generator: torch.Generator):
    nothing = Gaussians(**{name: getattr(scene_of(generator), name)[:0] for name in INPUTS})
    view = view_of(camera_of("panorama", 40, 20))
    drawn = CapturedRender(lambda _: nothing, view)(view.cam_from_world)
    assert not drawn.image.any() and (drawn.transmittance == 1).all() and drawn.counters["instances"] == 0


def test_frames_that_need_strips_are_refused(generator: torch.Generator):
    gaussians, view = scene_of(generator), view_of(camera_of("panorama", 72, 36))
    message = r"has \d+ \(Gaussian, tile\) instances; max_instances=30 draws them in strips, .* Raise max_instances"
    with pytest.raises(ValueError, match=message):
        CapturedRender(lambda _: gaussians, view, RenderOptions(max_instances=30))
    draw = CapturedRender(lambda _: gaussians, view, RenderOptions(max_instances=30), capacity=20)
    for _ in range(2):
        with pytest.raises(ValueError, match=message):
            draw(view.cam_from_world)


def test_unsupported_recordings_are_refused(generator: torch.Generator):
    gaussians, view = scene_of(generator), view_of(camera_of("panorama", 72, 36))
    with pytest.raises(ValueError, match="cubemap=true cannot be recorded; use padgs"):
        CapturedRender(lambda _: gaussians, view, RenderOptions("tangent", cubemap=True))
    for capacity in (0, 11):
        with pytest.raises(ValueError, match=f"capacity is {capacity}; it must be 1 to 10 instances"):
            CapturedRender(lambda _: gaussians, view, RenderOptions(max_instances=10), capacity=capacity)
    with pytest.raises(ValueError, match="takes float32 tensors on a GPU, got torch.float64"):
        CapturedRender(lambda _: gaussians.to(torch.float64), view)
    with pytest.raises(ValueError, match=r"cam_from_world has shape \(3, 4\); it must be \(4, 4\)"):
        CapturedRender(lambda _: gaussians, view)(torch.eye(4)[:3])


@pytest.mark.usefixtures("dirty_memory")
def test_instance_counts_beyond_32_bits():
    """Slots must not wrap around to 0, where they would overwrite the first ones."""
    side, count, capacity = 8192, 16_400, 100
    view = DeviceProjected.__new__(DeviceProjected)
    view.camera = native_camera(cuda_backend.IDENTITY, camera_of("pinhole", side, side), RenderOptions("pinhole"))
    view.queue, view.capacity, view.visible = cuda.queue(DEVICE), capacity, count
    view.boxes = torch.tensor([0, side, 0, 0, side], dtype=torch.int32, device=DEVICE).repeat(count, 1)
    view.order = torch.arange(count, dtype=torch.int32, device=DEVICE)
    strip = DeviceStrip(view, 0, side // 16)
    assert count * strip.tiles > 2**32
    wanted = (strip.tiles * torch.arange(count + 1)).clamp(max=2**31 - 1)
    assert torch.equal(strip.slot_start.cpu().long(), wanted)
    assert (strip.reaches[:, 0] == 0).all()
    assert torch.equal(strip.tile_start.cpu().long(), torch.arange(strip.tiles + 1).clamp(max=capacity))
