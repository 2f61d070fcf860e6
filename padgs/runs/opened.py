"""A run opened from Python: its method, scene and scores, and pictures as arrays; finished or not."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import OmegaConf
from yaml import YAMLError

from padgs import results
from padgs.data.camera_paths import interpolate_poses
from padgs.data.capture import DataError
from padgs.evaluation.protocols import PROTOCOLS
from padgs.geometry.camera import Camera, Panorama, Pinhole
from padgs.results import Result, Scores
from padgs.runs import checkpoint
from padgs.runs.config import RunConfig, config_from_values, known_to
from padgs.runs.device import chosen
from padgs.runs.folder import PROGRESS, Progress, RunFolder, RunFolderError
from padgs.runs.identity import config_hash
from padgs.runs.scoring import scores
from padgs.runs.session import build, scene_of
from padgs.scene import Scene, View
from padgs.training.method import Method


@dataclass(frozen=True)
class Picture:
    """What a method shows of a view, as float32 arrays."""

    image: np.ndarray  # [H, W, 3] colours in [0, 1]
    depth: np.ndarray  # [H, W] world units from the camera, the mean by contribution; 0 where there is nothing
    alpha: np.ndarray  # [H, W] in [0, 1], 1 where nothing of the background is seen


def draw(method: Method, view: View) -> Picture:
    """What a trained method shows of a view.

    Raises:
        RuntimeError: the method has no model yet.
    """
    rendering = method.render(view)
    image, depth = rendering.image.clamp(0, 1), rendering.depth
    return Picture(*(tensor.float().cpu().numpy() for tensor in (image, depth, 1 - rendering.transmittance)))


@dataclass
class OpenedRun:
    """What `load_run` returns."""

    folder: Path  # of the run
    config: RunConfig
    method: Method  # as its last checkpoint left it
    result: Result | None  # what `result.json` says; None where the run is not finished
    iteration: int  # after which its last checkpoint was written
    digest: str  # of that checkpoint

    @property
    def files(self) -> RunFolder:
        """The files of the run."""
        return RunFolder(self.folder)

    @cached_property
    def scene(self) -> Scene:
        """The scene that it was trained on, loaded when first asked for.

        Warns where that has changed since: poses and units may be others than the model's.

        Raises:
            DataError: it is not where it was; `load_run(folder, data_path=...)` says where it is now.
        """
        scene = scene_of(self.config, chosen(self.config.run.device, self.config.render))
        if not self._was_trained_on(scene):
            warnings.warn(f"{self.folder} was trained on other data than {self._place} holds now", stacklevel=3)
        return scene

    def refuse_other_data(self) -> None:
        """For whoever goes on training, or compares.

        Raises:
            DataError: its data set has changed since.
        """
        if not self._was_trained_on(self.scene):
            raise DataError(
                f"{self.folder} was trained on other data than {self._place} holds now; say with --data where "
                "those are, or train again on these"
            )

    @property
    def _place(self) -> str:
        """Where its data are, in words."""
        return str(self.config.data.path or "the generator")

    def _was_trained_on(self, scene: Scene) -> bool:
        return self.result is None or self.result.fingerprint == scene.fingerprint

    @property
    def scores(self) -> dict[str, Scores]:
        """Protocol -> the marks of the test views, as `result.json` has them; empty where the run is not finished."""
        return self.result.scores if self.result is not None else {}

    def renewed(self) -> OpenedRun | None:
        """The run as training has left it since, on the same scene; None where it has come no further, nor to its end.

        Raises:
            CheckpointError: its checkpoint cannot be read, perhaps because the next one takes its place right now.
            RunFolderError, ResultError, OSError: nor can another file of it.
        """
        if checkpoint.digest(self.files.checkpoint) == self.digest and self.files.result() == self.result:
            return None
        run = load_run(self.folder, data_path=self.config.data.path, device=self.config.run.device)
        if "scene" in self.__dict__:  # loaded already
            run.scene = self.scene
        return run

    def render(self, view: View) -> Picture:
        """What it shows of a view: one of its scene, or the same camera elsewhere, `view.at(cam_from_world)`."""
        return draw(self.method, view)

    def score(self, protocol: str) -> Scores:
        """The marks of the test views now, under a protocol of the run or a known one.

        Raises:
            ValueError: unknown protocol, or there are no test views.
        """
        rules = {**PROTOCOLS, **self.config.protocols}
        if protocol not in rules:
            raise ValueError(f"unknown protocol {protocol!r}; known: {', '.join(rules)}")
        return scores(self.method, self.scene, {protocol: rules[protocol]}, None)[protocol]

    def camera_path(self, frames: int) -> list[View]:
        """Views along a path through the training cameras in their order, `frames` of them, evenly spaced in number.

        Raises:
            ValueError: fewer than two training views or frames.
        """
        views = self.scene.train
        if len(views) < 2 or frames < 2:
            raise ValueError(f"a path of {frames} frames through {len(views)} views; it takes at least two of both")
        poses = interpolate_poses(
            torch.stack([view.cam_from_world for view in views]), np.linspace(0, len(views) - 1, frames)
        )
        return [
            replace(views[0].at(pose.to(views[0].cam_from_world)), name=f"frame-{number:05d}")
            for number, pose in enumerate(poses)
        ]

    def through(self, camera: Camera) -> Method:
        """The method as this camera sees it: the run's own, or a copy that draws what that does not.

        Filters keep the angle that they had in training where the camera has finer pixels, as between those Gaussians
        were never seen, but for a model that sees to that itself; a projection of whole panoramas gives way to
        `pinhole` for a perspective camera.
        """
        ways, trained = self.config.render, self.scene.train[0].camera
        if isinstance(camera, Pinhole):
            only = ways.projection == "erp" or ways.cubemap
            kind = "angular" if only and ways.low_pass_kind in ("auto", "pixels") else ways.low_pass_kind
            ways = replace(
                ways,
                projection="pinhole" if only else ways.projection,
                low_pass_kind=kind,
                cubemap=False,
                face_size=None,
                pixel_bias=0.0,
                bounds="exact",
                wrap=True,
                memory_cap=None,
            )
        finer = max(1.0, camera.focal / trained.focal)
        if not isinstance(camera, Panorama):
            finer /= self.method.CUT_FINENESS
        if not (ways.low_pass_kind == "fixed" or self.method.is_drawn_no_finer):
            ways = replace(ways, low_pass=ways.low_pass * finer**2)
        return self.method if ways == self.config.render else self.method.drawn_with(ways)


def load_run(folder: str | Path, *, data_path: str | Path | None = None, device: str = "auto") -> OpenedRun:
    """Open the folder of a run.

    Args:
        folder: with `config.yaml` and `checkpoint/`, as `padgs-run` writes them.
        data_path: where the data set is now, if not where it was.
        device: auto, cpu or cuda.

    Raises:
        RunFolderError: it is no such folder, or has no checkpoint.
        CheckpointError, ResultError, ConfigError: one of its files is damaged, or of another version.
        ValueError, OSError: a device that is not there, or cannot draw this.
    """
    files = RunFolder(Path(folder))
    settings = files.path / results.CONFIG_NAME
    if not settings.is_file() or not checkpoint.exists(files.checkpoint):
        raise RunFolderError(
            f"{folder} has no {'checkpoint' if settings.is_file() else settings.name}; give the folder of one run, as "
            "padgs-run names it at its end"
        )
    try:
        values: Any = OmegaConf.to_container(OmegaConf.load(settings))
        run = {"configuration": config_hash(values)}  # the data are not looked at
        values["data"].pop("device", None)  # of runs until run.device decided alone
        values["method"] = known_to(values["method"])
        values["data"]["path"] = values["data"]["path"] if data_path is None else str(data_path)
        values["run"]["device"] = device
    except (YAMLError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise RunFolderError(f"{settings} is no configuration that padgs-run wrote ({error}); put that back") from error
    config = config_from_values(values)
    method = build(config)
    digest = checkpoint.digest(files.checkpoint)
    state = checkpoint.load(files.checkpoint, chosen(device, config.render), run)
    with checkpoint.understood(files.checkpoint):
        method.load_state(state)
        iteration = Progress(**state.values[PROGRESS]).iteration
    return OpenedRun(files.path, config, method, files.result(), iteration, digest)
