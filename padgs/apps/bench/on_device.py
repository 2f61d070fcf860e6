"""A workload on a device: what it keeps there, and the work that one times."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import torch

from padgs.apps.bench.workload import Workload
from padgs.render import Rendering, RenderOptions, render, resolve_backend
from padgs.render.backends.captured import CapturedRender
from padgs.scene import Scene, View


class OnDevice:
    """A workload that is drawn and trained on a device."""

    def __init__(self, work: Workload, options: RenderOptions, device: torch.device) -> None:
        work.model.to(device)
        work = dataclasses.replace(work, scene=resident(work.scene, device))
        self.work, self.options, self.device = work, options, device
        self.backend = resolve_backend("auto", work.model.positions)
        self._records = work.trainer(options).records()

    def frame(self) -> Rendering:
        """Decode and draw."""
        with torch.no_grad():
            decoded = self.work.model.decode(self.work.view)
            return render(decoded.gaussians, self.work.view, self.options, backend=self.backend)

    def decoding(self, precision: str) -> Callable[[], object]:
        """Decode without drawing."""
        model = self.work.model

        def work() -> None:
            model.options = dataclasses.replace(usual, precision=precision)
            with torch.no_grad():
                model.decode(self.work.view)
            model.options = usual

        usual = model.options
        return work

    def captured_frame(self) -> Callable[[], object] | None:
        """The same, recorded and played back; None if the backend cannot."""
        if self.backend != "cuda":
            return None
        pose = self.work.view.cam_from_world.to(self.device)
        draw = CapturedRender(self.work.model.show, self.work.view, self.options)
        return lambda: draw(pose)

    def train(self) -> None:
        """One iteration of the trainer."""
        next(self._records)

    def explicit(self) -> Callable[[], object]:
        """One iteration of the trainer of as many explicit Gaussians."""
        records = self.work.explicit_trainer(self.options).records()
        return lambda: next(records)


def resident(scene: Scene, device: torch.device) -> Scene:
    """The scene as a run trains on it: poses on the device, and panoramas as bytes there."""

    def held(view: View) -> View:
        assert view.load_pixels is not None, view.name
        pixels = view.load_pixels().to(device)
        return dataclasses.replace(view, load_pixels=lambda: pixels)

    moved = scene.to(device)
    return dataclasses.replace(moved, train=tuple(map(held, moved.train)))
