"""World of a file of Gaussians: transforms that users state, and a check that the file's world is the scene's."""

import json
import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from padgs.data.capture import DataError
from padgs.data.formats.path_file import TRANSFORMS, nerfstudio_world
from padgs.data.splits import read_lines
from padgs.evaluation.metrics import mean_color, sphere_weight, ws_psnr
from padgs.evaluation.scoring import ONE_COLOR, Render
from padgs.geometry.similarity import Similarity
from padgs.scene import Scene, View

IDENTITY = "identity"
WIDTH, VIEWS, SEARCHED = 128, 4, 2  # of the low-resolution renders; views of the search for another world
MARGIN, LEAST = 3.0, 1.0  # dB above one colour per view: in the right world for sure; if no other world is better
COARSE, FINE = (1000, 25), (6000, 100)  # points and iterations of the alignment by closest points
INLIERS = 0.8  # share of the Gaussians that an iteration of it uses
FINALISTS = 5  # of the aligned worlds, by distance of points; these are aligned finely and rendered


def read_transform(text: str, transforms_json: Path | None = None) -> Similarity:
    """Return the similarity scene_from_file that a user states: identity, 12 or 16 numbers (matrix rows), or a file.

    Files hold numbers (.json, .npy, text). nerfstudio's `dataparser_transforms.json` is inverted, because it maps the
    world of the data set to that of the model; it includes the `applied_transform` of the data set's `transforms_json`.
    """
    if text == IDENTITY:
        return Similarity()
    file, is_file = Path(text), os.path.isfile(text)  # Path.is_file refuses long texts
    try:
        if is_file and file.suffix.lower() == ".npy":
            numbers: Any = np.load(file)
        elif is_file and file.suffix.lower() == ".json":
            numbers = json.loads(file.read_bytes())  # in UTF-8 or UTF-16
            if isinstance(numbers, dict):
                return nerfstudio_world(file, transforms_json)
        else:
            numbers = (" ".join(read_lines(file)) if is_file else text).replace(",", " ").split()
        matrix = np.asarray(numbers, np.float64).reshape(-1, 4)
    except DataError as error:  # which would be taken for one of the run's data
        raise ValueError(str(error)) from error
    except (ValueError, TypeError, EOFError, OverflowError) as error:
        raise ValueError(
            f"--transform {text} is no file and no 12 or 16 numbers ({error}); give a 4x4 matrix that maps the file's "
            f"world to the scene's, row by row, or {IDENTITY}"
        ) from error
    return _similarity(matrix, text)


def _similarity(matrix: np.ndarray, text: str) -> Similarity:
    rule = "it must be a rotation times a scale, with a translation: rows of 4 numbers, the last one 0 0 0 1"
    is_affine = matrix.shape == (3, 4) or matrix.shape == (4, 4) and np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-6)
    if not is_affine or not np.isfinite(matrix).all():
        raise ValueError(f"--transform {text} has {matrix.size} numbers, not those of a similarity; {rule}")
    scale = np.cbrt(np.linalg.det(matrix[:3, :3]))
    rotation = matrix[:3, :3] / (scale or 1)
    if scale < 0:
        raise ValueError(f"--transform {text} is a mirror image, which no rotation of Gaussians is; {rule}")
    if scale == 0 or np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3:
        raise ValueError(f"--transform {text} shears, or scales axes differently; {rule}")
    u, _, vh = np.linalg.svd(rotation)
    return Similarity(float(scale), torch.from_numpy(u @ vh), torch.from_numpy(matrix[:3, 3].copy()))


def as_numbers(similarity: Similarity) -> str:
    """Return a similarity as an argument of --transform: the rows of its matrix."""
    rows = torch.cat((similarity.scale * similarity.rotation, similarity.translation[:, None]), dim=1)
    rows = torch.where(rows.abs() < 1e-9, 0.0, rows)  # no -0
    digits = 15 if rows[:, 3].abs().max() > 1e4 else 7  # rotations of map coordinates move them far
    return "  ".join(" ".join(f"{n:.{digits}g}" for n in row) for row in rows.tolist())


@dataclass(frozen=True)
class FrameCheck:
    """PSNR of low-resolution renders of training views; if that is low, better rays, or a better world of the file."""

    psnr: float
    one_color: float  # PSNR of the mean colour of each view
    suggestion: Similarity | None = None  # scene_from_file
    rays: str = ""  # a name of `others` that shows the scene
    words: str = ""
    suggested_psnr: float = 0.0

    @property
    def fits(self) -> bool:
        """True if the renders show the scene."""
        return self.psnr >= self.one_color + (MARGIN if self.suggestion or self.rays else LEAST)

    def __str__(self) -> str:
        if self.psnr == math.inf:
            return "the training views compared have one colour each, so the world of the file cannot be checked"
        text = f"training views at {WIDTH} pixels: {self.psnr:.1f} dB; one colour each: {self.one_color:.1f} dB"
        if self.fits:
            return f"{text}; the file is in the world of the scene"
        if self.rays:
            return f"{text}; {self.suggested_psnr:.1f} dB with --rays {self.rays}: add that"
        text += "; the file is not in the world of the scene, or shows something else"
        if self.suggestion is None:
            return f"{text}. No change of axes, scale and place was found that fits"
        return f'{text}. {self.suggested_psnr:.1f} dB {self.words}: --transform "{as_numbers(self.suggestion)}"'


def check_frame(
    scene: Scene,
    render: Render,
    means: Tensor,
    nerfstudio: Similarity | None = None,
    others: Mapping[str, Render] = MappingProxyType({}),
) -> FrameCheck:
    """Render training views at a low resolution; if they do not fit, try `others`, and search for a better world.

    `render`, and `others` by the name of their rays, draw a view; `means` [N, 3] are those of the opaque Gaussians;
    `nerfstudio` is the scene_from_file of nerfstudio's `dataparser_transforms.json`, if there is one.
    """
    views = [view for view in scene.train if view.lens is None]
    views = views[:: max(1, len(views) // VIEWS)][:VIEWS]
    truths = [_small(view) for view in views]
    constants = [mean_color(truth, sphere_weight(truth, mask)).item() for _, truth, mask in truths]
    if not (compared := [index for index, constant in enumerate(constants) if constant < ONE_COLOR]):
        return FrameCheck(math.inf, 0.0)
    truths, flat = [truths[index] for index in compared], mean(constants[index] for index in compared)

    def quality(scene_from_file: Similarity, count: int = VIEWS, draw: Render = render) -> float:
        back = scene_from_file.inverse()  # moves the camera, not the Gaussians
        marks = [
            ws_psnr(draw(view.at(back.pose(view.cam_from_world))).image.clamp(0, 1).to(truth), truth, mask)
            for view, truth, mask in truths[:count]
        ]
        return torch.stack(marks).mean().item()

    found = FrameCheck(quality(Similarity()), flat)
    if found.psnr >= flat + MARGIN or not len(means):
        return found
    best = found
    for rays, draw in others.items():
        mark = quality(Similarity(), draw=draw)
        if mark > max(best.suggested_psnr, found.psnr + LEAST, flat + LEAST):
            best = FrameCheck(found.psnr, flat, rays=rays, suggested_psnr=mark)
    for words, similarity in _worlds(scene, means, nerfstudio):
        mark = quality(similarity, SEARCHED)
        if mark > max(best.suggested_psnr, found.psnr + LEAST, flat + LEAST):
            best = FrameCheck(found.psnr, flat, similarity, words=words, suggested_psnr=mark)
    return best


def _small(view: View) -> tuple[View, Tensor, Tensor | None]:
    """Return a view of `WIDTH` pixels, its image and its mask."""

    def reduced(image: Tensor) -> Tensor:
        return torch.nn.functional.interpolate(image.movedim(-1, 0)[None], (WIDTH // 2, WIDTH), mode="area")[0]

    mask = view.mask()
    small = View(view.name, view.cam_from_world, WIDTH, WIDTH // 2)
    return small, reduced(view.image()).movedim(0, -1), None if mask is None else reduced(mask[..., None])[0]


def _worlds(scene: Scene, means: Tensor, nerfstudio: Similarity | None) -> Iterator[tuple[str, Similarity]]:
    """Yield worlds that a file may be in: nerfstudio's, those with other axes, and those aligned to the points."""
    from scipy.spatial.transform import Rotation

    if nerfstudio is not None:
        yield f"with nerfstudio's {TRANSFORMS}", nerfstudio
    turns = torch.from_numpy(Rotation.create_group("O").as_matrix().round())  # axes to axes, the identity first
    for turn in turns[1:]:
        yield "with other axes", Similarity(rotation=turn)
    if means.eq(means[0]).all():  # one place has no scale
        return
    starts = [_closest_points(scene.points, means, Similarity(0.0, turn), *COARSE) for turn in turns]
    for _, start in sorted(starts, key=lambda found: found[0])[:FINALISTS]:
        aligned = _closest_points(scene.points, means, start, *FINE)[1]
        yield "with another scale and place (estimated from points)", aligned


def _closest_points(
    points: Tensor, means: Tensor, start: Similarity, count: int, iterations: int
) -> tuple[float, Similarity]:
    """Align means to points iteratively, first by medians if `start` has scale 0; return the median distance, too."""
    from scipy.spatial import KDTree

    target, source = (cloud[:: max(1, len(cloud) // count)].double().cpu().numpy() for cloud in (points, means))
    scale, rotation, shift = start.scale, start.rotation.numpy(), start.translation.numpy()
    if not scale:
        centre, middle = np.median(target, 0), np.median(source, 0)
        pairs = ((target, centre), (source, middle))
        spread, own = (np.median(np.linalg.norm(cloud - at, axis=1)) for cloud, at in pairs)
        scale = spread / max(own, 1e-12)
        shift = centre - scale * rotation @ middle
    tree = KDTree(target)
    for _ in range(iterations):
        distances, nearest = tree.query(scale * source @ rotation.T + shift)
        kept = distances <= np.quantile(distances, INLIERS)
        a, b = target[np.asarray(nearest)[kept]], source[kept]
        u, sizes, vh = np.linalg.svd((a - a.mean(0)).T @ (b - b.mean(0)))
        signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vh))])
        rotation = u * signs @ vh
        scale = (sizes * signs).sum() / np.square(b - b.mean(0)).sum()
        shift = a.mean(0) - scale * rotation @ b.mean(0)
    distance = float(np.median(tree.query(scale * source @ rotation.T + shift)[0]))
    return distance, Similarity(float(scale), torch.from_numpy(rotation), torch.from_numpy(shift))
