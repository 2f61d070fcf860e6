"""Load a run from Python: its method, scene and scores, and renders as arrays; finished or not."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Container, Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from padgs import results
from padgs.checks import ConfigError, unknown
from padgs.data.camera_paths import along_cameras
from padgs.data.capture import DataError
from padgs.evaluation.protocols import PROTOCOLS
from padgs.evaluation.scoring import score
from padgs.geometry.camera import Camera, Panorama, Pinhole
from padgs.results import Result, Scores
from padgs.runs import checkpoint
from padgs.runs.config import DEVICES, RunConfig, choose_device, config_from_values
from padgs.runs.run import build_method, load_scene
from padgs.runs.store import PROGRESS, Progress, RunFolderError, RunStore, config_hash
from padgs.scene import Scene, View
from padgs.training.method import Method

KEYWORDS = ("", "auto", "random", "none", "inverted")  # of points, mask and images; they name no file


@dataclass(frozen=True)
class Picture:
    """A render as float32 arrays."""

    image: np.ndarray  # [H, W, 3] colours in [0, 1]
    depth: np.ndarray  # [H, W] mean distance by contribution, world units; 0 where nothing is drawn
    alpha: np.ndarray  # [H, W] in [0, 1]; 1 hides the background


def draw(method: Method, view: View) -> Picture:
    """Render a view of a trained method as arrays."""
    rendering = method.render(view)
    image, depth = rendering.image.clamp(0, 1), rendering.depth
    return Picture(*(tensor.float().cpu().numpy() for tensor in (image, depth, 1 - rendering.transmittance)))


@dataclass
class LoadedRun:
    """A run folder in memory, as `load_run` returns it."""

    folder: Path
    config: RunConfig
    method: Method  # loaded from the last checkpoint
    result: Result | None  # None if the run is not finished
    iteration: int  # of the last checkpoint
    digest: str  # of the last checkpoint
    opened_with: tuple[str, ...] = field(default=(), kw_only=True)  # options of the command line
    notes: tuple[str, ...] = field(default=(), kw_only=True)  # what its user should know

    @property
    def files(self) -> RunStore:
        """The files of the run."""
        return RunStore(self.folder)

    @cached_property
    def scene(self) -> Scene:
        """The scene that the run was trained on, loaded at first access.

        Warns if the data have changed since; a DataError if they have moved: give `load_run` their `data_path`.
        """
        scene = load_scene(self.config, choose_device(self.config.run.device, self.config.render))
        if difference := self._difference(scene):
            warnings.warn(difference, stacklevel=3)
        return scene

    def refuse_other_data(self) -> None:
        """Refuse a data set that has changed since training with a DataError."""
        if difference := self._difference(self.scene):
            raise DataError(f"{difference}; pass the right folder with --data, or train again on these data")

    def _difference(self, scene: Scene) -> str:
        if self.result is None or self.result.fingerprint == scene.fingerprint:
            return ""
        return f"{self.folder} was trained on other data than {self.config.data.path or 'the generator'} holds"

    @property
    def scores(self) -> dict[str, Scores]:
        """Protocol -> scores of the test views, as in `result.json`; empty if the run is not finished."""
        return self.result.scores if self.result is not None else {}

    def renewed(self) -> LoadedRun | None:
        """Return the run as training has left it since, on the same scene; None if nothing has changed.

        An error that a file cannot be read may be over when a new checkpoint has been written.
        """
        if checkpoint.digest(self.files.checkpoint) == self.digest and self.files.result() == self.result:
            return None
        run = load_run(self.folder, data_path=self.config.data.path, device=self.config.run.device)
        run.opened_with = self.opened_with
        if "scene" in self.__dict__:  # loaded already
            run.scene = self.scene
        return run

    def render(self, view: View) -> Picture:
        """Render a view of the run's scene, or the same camera elsewhere: `view.at(cam_from_world)`."""
        return draw(self.method, view)

    def score(self, protocol: str) -> Scores:
        """Score the test views under a protocol of the run or a built-in one."""
        rules = {**PROTOCOLS, **self.config.protocols}
        if protocol not in rules:
            raise ValueError(f"unknown protocol {protocol!r}; known: {', '.join(rules)}")
        return score(self.method.render, self.scene, {protocol: rules[protocol]}, None)[protocol]

    def camera_path(self, frames: int) -> list[View]:
        """Return `frames` views along the path through the training cameras that `padgs render` takes."""
        camera = self.scene.train[0]
        poses = along_cameras(self.scene, frames)
        return [replace(camera.at(pose.numpy()), name=f"frame-{number:05d}") for number, pose in enumerate(poses)]

    def through(self, camera: Camera) -> Method:
        """Return a method that can render this camera: the run's own, or a copy with other render settings.

        If the camera has finer pixels than training had, fewer samples a pixel are as close together, and low-pass
        filters keep their angle, because Gaussians were never seen between those pixels; methods with a smoothing
        filter of their own need no such change. Projections of whole panoramas are replaced by `pinhole` for a
        perspective camera.
        """
        settings, trained = self.config.render, self.scene.train[0].camera
        if isinstance(camera, Pinhole):
            panoramic = settings.projection == "erp" or settings.cubemap
            angular = panoramic and settings.low_pass_kind in ("auto", "pixels")
            projection = "pinhole" if panoramic else settings.projection
            kind = "angular" if angular else settings.low_pass_kind
            exact = {"cubemap": False, "bounds": "exact", "wrap": True}
            settings = replace(settings, projection=projection, low_pass_kind=kind, **exact)
        finer = max(1.0, camera.focal / trained.focal)
        if not isinstance(camera, Panorama):
            finer /= self.method.CUT_FINENESS
        samples = math.ceil(settings.supersampling / max(1.0, finer) - 1e-6)
        finer *= samples / settings.supersampling
        settings = replace(settings, supersampling=samples)
        if not self.method.has_smoothing_filter:
            settings = replace(settings, low_pass=settings.low_pass * finer**2)
        return self.method if settings == self.config.render else self.method.with_renderer(settings)


def load_run(folder: str | Path, *, data_path: str | Path | None = None, device: str = "auto") -> LoadedRun:
    """Load a run folder: `config.yaml` and `checkpoint/`, as `padgs-run` writes them.

    `data_path` is the folder of the data set if it has moved. `device` is auto, cpu or cuda; a run whose native
    backend is not for it is rendered by that of the device. A RunFolderError says that it is no run folder;
    CheckpointError, ResultError and ConfigError name a file that is damaged or of another version.
    """
    if device not in DEVICES:
        raise ValueError(unknown("device", device, DEVICES))
    path = Path(folder)
    store = RunStore(path.resolve() if path.name in ("", "..") else path)  # names of files are made of the last part
    settings = store.path / results.CONFIG_NAME
    if not settings.is_file() or not store.has_checkpoint:
        found = f"{folder} has no {'checkpoint' if settings.is_file() else settings.name}"
        if store.path.is_file():
            found = f"{folder} is a file"
        elif (store.path / results.FILE_NAME).is_file() and not settings.is_file():
            found = f"{folder} has no {settings.name}: the same padgs-run restores it; a model from elsewhere is a file"
        raise RunFolderError(f"{found}; give the folder of one run, as padgs-run names it at its end")
    try:
        values: Any = OmegaConf.to_container(OmegaConf.load(settings))
        run = {"configuration": config_hash(values)}  # the data are not read
        source, up = values["data"], (Path(), *store.path.absolute().parents)  # training began in one of these
        source["path"] = _found(source["path"], up, ("",)) if data_path is None else str(data_path)
        source |= {key: _found(source[key], (Path(source["path"] or ""), *up)) for key in ("points", "mask", "images")}
        if source.get("disk_cache") not in (None, "auto", "off") and not os.path.isdir(source["disk_cache"]):
            source["disk_cache"] = "auto"  # that folder was on the machine that trained
        values["run"]["device"] = device
        if values["render"]["backend"] in missing_backends(device):
            values["render"]["backend"] = "auto"
    except (YAMLError, OmegaConfBaseException, OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise RunFolderError(f"{settings} is not a configuration of padgs-run ({error}); restore it") from error
    try:
        config = config_from_values(values)
    except ConfigError as error:
        advice = "another version of padgs wrote it, or it was edited: use that version, or train again"
        raise ConfigError(f"{settings}: {error}; {advice}") from error
    method = build_method(config)
    digest = checkpoint.digest(store.checkpoint)
    state = checkpoint.load(store.checkpoint, choose_device(device, config.render), run)
    with checkpoint.understood(store.checkpoint):
        method.load_state(state)
        iteration = Progress(**state.values[PROGRESS]).iteration
    result = store.result()
    notes = () if result else (f"the run has not ended; its model is that of iteration {iteration}",)
    return LoadedRun(store.path, config, method, result, iteration, digest, notes=notes)


def _found(path: str | None, folders: Iterable[Path], keywords: Container[str] = KEYWORDS) -> str | None:
    """Return a path, maybe after `inverted:`, within the first of some folders that has it; if none has, as it is."""
    prefix, colon, name = (path or "").rpartition("inverted:")
    if prefix or name in keywords:
        return path
    there = (str(folder / name) for folder in folders)
    return next((f"{colon}{place}" for place in there if os.path.exists(place)), path)  # or behind a closed folder


def missing_backends(device: str) -> set[str]:
    """Return the native backends that cannot render on a device (auto, cpu or cuda) of this machine."""
    gpu = torch.cuda.is_available() and device != "cpu"
    return {name for name, usable in {"cpu": device != "cuda", "cuda": gpu}.items() if not usable}
