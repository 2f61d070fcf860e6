"""Frames of one camera from changing poses, recorded once as a CUDA graph and replayed: for viewing and measuring.

`padgs.render.backends.cuda` waits within a frame for the number of (Gaussian, tile) instances to allocate memory for
them. Here the capacity is chosen beforehand, so that the host neither waits nor launches anything within a frame. The
kernels are the same, and so is every bit of the image. The number of instances is read after the frame; if it exceeds
the capacity, the frame is recorded again with a larger one, and rendered again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.native.abi import Inputs, pointer
from padgs.render.backends import cuda as cuda_backend
from padgs.render.backends.cuda import MAX_INSTANCES, DeviceProjected
from padgs.render.backends.native import native_camera, native_rays
from padgs.render.contract import Rendering, RenderOptions, Request, check_inputs
from padgs.scene import View

HEADROOM = 1.5  # capacity as a multiple of the counted instances


@dataclass(frozen=True)
class Frame:
    """The tensors of one recording, which every replay overwrites."""

    image: Tensor  # [H, W, 3]
    transmittance: Tensor  # [H, W]
    depth: Tensor  # [H, W]
    visible: Tensor  # [N]
    pairs: Tensor  # [2]
    projected: DeviceProjected  # kernels of the graph point to its tensors


class CapturedRender:
    """Render Gaussians with one camera from many poses, without gradients.

        draw = CapturedRender(lambda view: gaussians, view, options)
        rendering = draw(cam_from_world)

    Attributes:
        capacity: number of instances that memory is allocated for.
    """

    def __init__(
        self,
        show: Callable[[View], Gaussians],
        view: View,
        options: RenderOptions = RenderOptions(),  # noqa: B008 - frozen dataclass
        *,
        background: Tensor | None = None,
        capacity: int | None = None,
    ) -> None:
        """Count the instances of a first pose; the first rendered frame is recorded.

        Args:
            show: returns the Gaussians of a view, float32 tensors on a GPU. It is recorded too: it must launch the
                same work for every pose and read nothing back, and its Python is not run again. Its tensors are taken
                by reference: later writes to them are rendered. None may be replaced, as growth and `PaDGS.load` do: a
                replay would read freed memory. Make a new `CapturedRender` instead.
            view: the camera, and the first pose.
            options: as in `padgs.render.render`, without cubemap.
            background: [3] RGB, by reference; black if not given.
            capacity: number of instances; `HEADROOM` times those of the first pose if not given.

        Raises:
            ValueError: options or Gaussians that cannot be recorded, or more instances than `options.max_instances`,
                which need strips.
            OSError, RuntimeError, torch.cuda.OutOfMemoryError: as `cuda_backend.rasterize` does.
        """
        if options.cubemap:
            raise ValueError("frames with cubemap=true cannot be recorded; use padgs.render.render")
        self._most = min(options.max_instances, MAX_INSTANCES)
        if capacity is not None and not 1 <= capacity <= self._most:
            raise ValueError(f"capacity is {capacity}; it must be 1 to {self._most} instances (max_instances)")
        self._show, self._options = show, options
        self._replay: Callable[[], Frame] | None = None
        with torch.no_grad():
            means = (gaussians := show(view)).means
            cuda_backend.check(means)
            self._background = means.new_zeros(3) if background is None else background
            self._view = view.at(view.cam_from_world.to(means.device, copy=True).contiguous())
            pose = self._view.cam_from_world.to(means.dtype)
            check_inputs(Request(gaussians, pose, view.camera, options, self._background), check_values=False)
            self._camera = native_camera(cuda_backend.IDENTITY, view.camera, options)
            self._rays = native_rays(view.camera, means.device)
            self.capacity = capacity or self._capacity_for(self._projected(gaussians, capacity=0).instances)

    @torch.no_grad()
    def __call__(self, cam_from_world: Tensor) -> Rendering:
        """Render from a pose [4, 4], and wait for the frame. The result is a copy that no later frame overwrites.

        Raises:
            ValueError: another shape.
            ValueError, torch.cuda.OutOfMemoryError: the pose needs more capacity than is possible.
        """
        pose = self._view.cam_from_world
        if cam_from_world.shape != pose.shape:
            raise ValueError(f"cam_from_world has shape {tuple(cam_from_world.shape)}; it must be (4, 4)")
        pose.copy_(cam_from_world)
        while True:
            if self._replay is None:
                self._replay = captured(self._record, pose.device)
            frame = self._replay()
            *per_row, visible = frame.projected.counts.tolist()
            if sum(per_row) <= self.capacity:
                break
            self.capacity = self._capacity_for(sum(per_row))
            self._replay = frame = None  # free their memory before more is allocated
        known = {"gaussians": len(frame.visible), "visible": visible, "instances": sum(per_row)}
        counters = cuda_backend.Counters(frame.pairs.clone(), **known)
        image, transmittance, depth = frame.image.clone(), frame.transmittance.clone(), frame.depth.clone()
        return Rendering(image, transmittance, depth, frame.visible.clone(), counters)

    def _capacity_for(self, instances: int) -> int:
        if instances > self._most:
            raise ValueError(
                f"this pose has {instances:,} (Gaussian, tile) instances; max_instances={self._most:,} draws them in "
                "strips, which cannot be recorded. Raise max_instances, or use padgs.render.render"
            )
        return min(self._most, int(HEADROOM * instances) + 1)

    def _projected(self, gaussians: Gaussians, *, capacity: int) -> DeviceProjected:
        tensors = [tensor.contiguous() for tensor in vars(gaussians).values()]  # must outlive the call
        pose = self._view.cam_from_world.to(torch.float32)
        inputs = Inputs(len(gaussians), *map(pointer, tensors), None)
        return DeviceProjected(self._camera, pose, inputs, self._options.max_instances, capacity=capacity)

    def _record(self) -> Frame:
        """Do all work of a frame without waiting for the device."""
        projected = self._projected(self._show(self._view), capacity=self.capacity)
        outputs = cuda_backend.Outputs.allocate(self._view.camera, self._options, projected.order.device)
        background = self._background.contiguous()  # must outlive the call
        pairs = cuda_backend.blend(projected, self._rays, background, outputs)
        visible = projected.boxes[:, 3] < projected.boxes[:, 4]
        return Frame(outputs.image, outputs.transmittance, outputs.depth, visible, pairs, projected)


def captured(record: Callable[[], Frame], device: torch.device) -> Callable[[], Frame]:
    """Record the launches of `record` in a CUDA graph; return a function that replays it into the same tensors."""
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.device(device):
        aside = torch.cuda.Stream()
        aside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(aside):  # run once before: nothing may be loaded or cached while recording
            record()
        torch.cuda.current_stream().wait_stream(aside)
        # A stream of this device (torch's default one belongs to the first device that recorded); thread_local: work of
        # other threads, such as allocations, does not end the recording.
        with torch.cuda.graph(graph, stream=aside, capture_error_mode="thread_local"):
            frame = record()

    def replay() -> Frame:
        with torch.cuda.device(device):
            graph.replay()
        return frame

    return replay
