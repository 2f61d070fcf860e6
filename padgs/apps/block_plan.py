"""Division of a large capture into blocks of cameras that see the same points.

Cameras that see the same points form a block (recursive spectral bisection of their normalized graph), whatever lies
between them on a plan. A point belongs to the block whose cameras see it best, and any other place to the block of the
nearest point. A block trains on its own cameras and on the margin: other cameras that see into it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from padgs.data.capture import Capture, DataError, view_name
from padgs.geometry.camera import Panorama
from padgs.geometry.distortion import solid_angle_weight
from padgs.methods.splats.depth_initialization import visible_points
from padgs.scene import Scene, View

SAMPLE = 50_000  # points at most that visibility is estimated for; the others follow the nearest of them
OCCLUSION = 1.05  # a point farther than so many times the surface is hidden
SLACK = 0.25  # cuts may deviate from equal blocks by this share, to pass through a door
ROWS = 48  # of the grid of directions that margin cameras are masked by
NEIGHBOURS = 4  # points that decide to which block a direction belongs, by at least half
RIM = 2  # cells of that grid by which masks are wider, so that both sides of a border train on it
MARGIN = 0.04  # share of the sphere of a margin camera that its block fills at least
SEEN = 0.1  # share of the cameras of a block that see a point of another block which it begins with


def bisect(affinity: np.ndarray, members: np.ndarray, count: int) -> list[np.ndarray]:
    """Divide nodes into `count` clusters of similar size by the normalized cut (Shi and Malik 2000) of [n, n]."""
    if count == 1:
        return [members]
    part = affinity[np.ix_(members, members)]
    degree = part.sum(1)
    scaled = part / np.sqrt(degree[:, None] * degree)
    order = np.argsort(np.linalg.eigh(scaled)[1][:, -2] / np.sqrt(degree), kind="stable")
    part, degree = part[np.ix_(order, order)], degree[order]
    best = (np.inf, 0, 0)  # cost, cut, first
    for first in {count // 2, count - count // 2}:
        share = len(members) * first / count
        low, high = math.floor(share * (1 - SLACK)), math.ceil(share * (1 + SLACK))
        for cut in range(max(low, first), min(high, len(members) - count + first) + 1):
            between = part[:cut, cut:].sum()
            cost = between / degree[:cut].sum() + between / degree[cut:].sum()
            best = min(best, (cost, cut, first))
    _, cut, first = best
    rest = bisect(affinity, members[order[cut:]], count - first)
    return [*bisect(affinity, members[order[:cut]], first), *rest]


def visibility(capture: Capture, views: Sequence[View], cloud: Tensor) -> np.ndarray:
    """Return which points each view sees, [views, points] bool: by tracks, else those on the nearest surfaces."""
    seen = np.zeros((len(views), len(cloud)), bool)
    if capture.tracks is not None and len((tracks := capture.tracks()).frame):
        rows = {view.name: row for row, view in enumerate(views)}
        row = np.array([rows.get(view_name(frame.name), -1) for frame in capture.frames])[tracks.frame.numpy()]
        seen[row[row >= 0], tracks.point.numpy()[row >= 0]] = True
    else:
        for row, view in enumerate(views):
            seen[row] = visible_points(cloud, view, OCCLUSION).numpy()
    return seen


@dataclass(frozen=True)
class Plan:
    """Division of a capture into blocks."""

    points: Tensor  # [S, 3] float64, of the cloud
    owner: np.ndarray  # [S] block of each point
    core: list[list[View]]  # training views of each block
    margin: list[list[View]]  # other views that see into it
    held: list[dict[str, np.ndarray]]  # view of core or margin -> directions [ROWS, 2 ROWS] that belong to it
    test: list[list[View]]
    used: np.ndarray  # [blocks, S] points that a block begins with


def plan(capture: Capture, scene: Scene, count: int) -> Plan:
    """Divide the views of a scene, in the world of its poses as the capture states them."""
    from scipy.ndimage import binary_dilation
    from scipy.sparse import csr_array
    from scipy.spatial import KDTree

    if capture.cloud is None or not len(capture.cloud.points):
        raise DataError(f"{capture.folder} has no points, which cameras of a block share; name a cloud by data.points")
    poses = {view_name(frame.name): frame.cam_from_world for frame in capture.frames}
    train, test = ([replace(v, cam_from_world=poses[v.name]) for v in side] for side in (scene.train, scene.test))
    if not 2 <= count <= len(train) // 2:
        raise DataError(f"--blocks is {count}; {len(train)} training views make 2 to {len(train) // 2} blocks")
    tracked = capture.tracks is not None and len(capture.tracks().frame) > 0
    step = 1 if tracked else max(1, math.ceil(len(capture.cloud.points) / SAMPLE))
    points = capture.cloud.points[::step].double()
    views, views_of_train = [*train, *test], np.arange(len(train))
    seen = visibility(capture, views, points)
    shared = csr_array(seen[: len(train)], dtype=np.float32)
    affinity = (shared @ shared.T).toarray().astype(np.float64)
    sizes = np.maximum(np.diag(affinity), 1)
    affinity = affinity / np.sqrt(sizes[:, None] * sizes) + 1e-6  # cameras that see nothing join any block
    clusters = sorted((np.sort(part) for part in bisect(affinity, views_of_train, count)), key=lambda part: part[0])
    owner = _owners(train, seen, points, clusters)
    rays = Panorama(2 * ROWS, ROWS).rays(dtype=torch.float64).reshape(-1, 3).numpy()
    share = np.zeros((len(views), count))  # of the sphere of each view that belongs to each block
    held: list[dict[str, np.ndarray]] = [{} for _ in clusters]
    for row, view in enumerate(views):
        if not len(index := seen[row].nonzero()[0]):
            continue
        toward = (points[index] - view.center) @ view.cam_from_world[:3, :3].T
        tree = KDTree(torch.nn.functional.normalize(toward, dim=1).numpy())
        near = owner[index][tree.query(rays, k=min(NEIGHBOURS, len(index)))[1]].reshape(len(rays), -1)
        for block in range(count):
            inside = ((near == block).mean(1) >= 0.5).reshape(ROWS, 2 * ROWS)
            share[row, block] = sphere_share(inside)
            if row < len(train) and share[row, block] >= MARGIN:
                around = np.hstack([inside] * 3)  # continued across the seam
                held[block][view.name] = binary_dilation(around, iterations=RIM)[:, 2 * ROWS : 4 * ROWS]
    margin, tests, used = [], [], np.zeros((count, len(points)), bool)
    best = share[len(train) :].argmax(1) if test else np.zeros(0, int)
    for block, cluster in enumerate(clusters):
        others = np.setdiff1d(views_of_train, cluster)
        margin.append([train[n] for n in others if train[n].name in held[block]])
        own = (best == block).nonzero()[0].tolist()
        own = own or [int(share[len(train) :, block].argmax())] if test else []
        tests.append([test[n] for n in own])
        used[block] = (seen[cluster].mean(0) >= SEEN) | (owner == block)
    return Plan(points, owner, [[train[n] for n in part] for part in clusters], margin, held, tests, used)


def sphere_share(held: np.ndarray) -> float:
    """Return the share of the sphere that directions [ROWS, 2 ROWS] fill."""
    return float(np.average(held.mean(1), weights=solid_angle_weight(ROWS, dtype=torch.float64).numpy()))


def _owners(train: Sequence[View], seen: np.ndarray, points: Tensor, clusters: Sequence[np.ndarray]) -> np.ndarray:
    """Return the block of each point: that whose cameras see it best, by the sum of 1 / distance^2."""
    weight = np.zeros((len(clusters), len(points)))
    for block, cluster in enumerate(clusters):
        for row in cluster:
            squared = (points - train[row].center).square().sum(1).numpy()
            weight[block] += (seen[row] + 1e-9) / np.maximum(squared, 1e-18)  # unseen ones follow the nearest cameras
    return weight.argmax(0)
