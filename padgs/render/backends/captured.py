"""Frames of one camera from changing poses, recorded once as a CUDA graph and played back: for viewing and measuring.

`padgs.render.backends.cuda` waits in the middle of a frame for the number of (Gaussian, tile) instances, because it
then allocates room for them. Here there is room for a number chosen beforehand, so that the host neither waits nor
launches anything within a frame. The kernels are the same, and so is every bit of the image. How many instances there
were is read after the frame; if they exceed the room, the frame is recorded anew with more of it, and drawn again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.native.abi import Inputs, pointer
from padgs.render.backends import cuda as cuda_backend
from padgs.render.backends.cuda_tiles import MAX_INSTANCES, DeviceProjected
from padgs.render.backends.native_camera import native_camera, native_rays
from padgs.render.contract import Rendering, RenderOptions, Request, check_inputs
from padgs.render.published_bounds import check_memory
from padgs.scene import View

HEADROOM = 1.5  # room for so many times the instances that were counted


@dataclass(frozen=True)
class Frame:
    """What one recording leaves; of a graph, the tensors that every playback overwrites."""

    image: Tensor  # [H, W, 3]
    transmittance: Tensor  # [H, W]
    depth: Tensor  # [H, W]
    visible: Tensor  # [N]
    pairs: Tensor  # [2]
    projected: DeviceProjected  # kernels of the graph point to its tensors


class CapturedRender:
    """Draws what one camera sees of some Gaussians, from pose after pose, without gradients.

        draw = CapturedRender(lambda view: gaussians, view, options)
        rendering = draw(cam_from_world)

    Attributes:
        room: instances that there is room for at present.
    """

    def __init__(
        self,
        show: Callable[[View], Gaussians],
        view: View,
        options: RenderOptions = RenderOptions(),  # noqa: B008 - frozen dataclass
        *,
        background: Tensor | None = None,
        room: int | None = None,
    ) -> None:
        """Count the instances of a first pose; the first frame that is drawn is recorded.

        Args:
            show: the Gaussians that a view shows, float32 tensors of a GPU. It is recorded too: it has to launch the
                same work for every pose and read nothing back, and its Python is not run again. Tensors that it holds
                are taken by reference: what is written into them is drawn from then on. None may be replaced by
                another, as growth and `PaDGS.load` do: a playback would read freed memory. Make a new `CapturedRender`.
            view: the camera, and the first pose.
            options: as in `padgs.render.render`, without cubemap and pixel bias.
            background: [3] RGB, by reference; black if not given.
            room: for so many instances; if not given, for those of the first pose and half as many in reserve.

        Raises:
            ValueError: options or Gaussians that cannot be recorded, or more instances than `options.max_instances`,
                which would be drawn in strips.
            MemoryError: more instances than `options.memory_cap` has room for.
            OSError, RuntimeError, torch.cuda.OutOfMemoryError: as `cuda_backend.rasterize` does.
        """
        if options.cubemap or options.pixel_bias:
            raise ValueError("frames with cubemap or pixel_bias cannot be recorded; draw them with padgs.render.render")
        self._most = min(options.max_instances, MAX_INSTANCES)
        if room is not None and not 1 <= room <= self._most:
            raise ValueError(f"room is {room}; it must be for 1 to {self._most} instances (max_instances)")
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
            self.room = room or self._room_for(self._projected(gaussians, room=0).instances)

    @torch.no_grad()
    def __call__(self, cam_from_world: Tensor) -> Rendering:
        """Draw from a pose [4, 4]; waits for the end of the frame. The result is a copy that no other frame overwrites.

        Raises:
            ValueError: not of this shape.
            ValueError, MemoryError, torch.cuda.OutOfMemoryError: there cannot be as much room as the pose needs.
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
            if sum(per_row) <= self.room:
                break
            self.room = self._room_for(sum(per_row))
            self._replay = frame = None  # gives their memory back before more is taken
        known = {"gaussians": len(frame.visible), "visible": visible, "instances": sum(per_row)}
        counters = cuda_backend.Counters(frame.pairs.clone(), **known)
        image, transmittance, depth = frame.image.clone(), frame.transmittance.clone(), frame.depth.clone()
        return Rendering(image, transmittance, depth, frame.visible.clone(), counters)

    def _room_for(self, instances: int) -> int:
        check_memory(instances, self._options)
        if instances > self._most:
            raise ValueError(
                f"this pose has {instances:,} (Gaussian, tile) instances; max_instances={self._most:,} draws them in "
                "strips, which cannot be recorded. Raise max_instances, or draw it with padgs.render.render"
            )
        return min(self._most, int(HEADROOM * instances) + 1)

    def _projected(self, gaussians: Gaussians, *, room: int) -> DeviceProjected:
        tensors = [tensor.contiguous() for tensor in vars(gaussians).values()]  # which must outlive the call
        pose = self._view.cam_from_world.to(torch.float32)
        inputs = Inputs(len(gaussians), *map(pointer, tensors), None)
        return DeviceProjected(self._camera, pose, inputs, self._options.max_instances, room=room)

    def _record(self) -> Frame:
        """All the work of a frame; nothing here waits for the device."""
        projected = self._projected(self._show(self._view), room=self.room)
        outputs = cuda_backend.Outputs.of(self._view.camera, self._options, projected.order.device)
        background = self._background.contiguous()  # which must outlive the call
        pairs = cuda_backend.blend(projected, self._rays, background, outputs)
        visible = projected.boxes[:, 3] < projected.boxes[:, 4]
        return Frame(outputs.image, outputs.transmittance, outputs.depth, visible, pairs, projected)


def captured(record: Callable[[], Frame], device: torch.device) -> Callable[[], Frame]:
    """Record what `record` launches in a CUDA graph; returns what plays it back, with the same tensors each time."""
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.device(device):
        aside = torch.cuda.Stream()
        aside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(aside):  # once before: nothing may be loaded, or cached, while recording
            record()
        torch.cuda.current_stream().wait_stream(aside)
        # Of this device (torch's own stream for it is of the first that anything was recorded on); what other threads
        # do meanwhile, such as allocating, does not end the recording.
        with torch.cuda.graph(graph, stream=aside, capture_error_mode="thread_local"):
            frame = record()

    def replay() -> Frame:
        with torch.cuda.device(device):
            graph.replay()
        return frame

    return replay
