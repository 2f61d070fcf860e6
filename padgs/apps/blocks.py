"""A large capture as blocks: `split` writes a data set per block, `merge` joins the models trained on them.

Cameras that see the same points form a block (recursive spectral bisection of their normalized graph), whatever lies
between them on a plan. A point belongs to the block whose cameras see it best, and any other place to the block of the
nearest point. A block trains on its own cameras and on the margin: other cameras that see into it. All are masked to
what belongs to it and a rim around that, and drawn in proportion to what that leaves. A merged model has of each run
the Gaussians that lie in its block.
"""

import hashlib
import json
import math
import os
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from torch import Tensor

import padgs.data
from padgs.data.assemble import assemble, view_name
from padgs.data.capture import Capture, Cloud, DataError, DataOptions
from padgs.data.depths import write_depths
from padgs.data.formats.json_file import read_json
from padgs.data.formats.transforms import REDUCED
from padgs.data.formats.writers import Content, write_transforms
from padgs.data.masks import write_masks
from padgs.files import draft_of
from padgs.geometry.camera import Panorama
from padgs.geometry.distortion import solid_angle_weight
from padgs.methods.splats.depth_initialization import visible_points
from padgs.methods.splats.model import SplatModel
from padgs.methods.splats.smoothing_filter import cameras_of
from padgs.results import flat
from padgs.runs.console import say, show_result
from padgs.runs.load import LoadedRun, load_run
from padgs.runs.run import build_method, initial_result, load_scene, scored, start
from padgs.runs.store import Labels, Progress, RunStore
from padgs.runs.warm_start import WarmStart
from padgs.scene import Scene, View
from padgs.training.model import MODEL, State

SAMPLE = 50_000  # points at most that visibility is estimated for; the others follow the nearest of them
OCCLUSION = 1.05  # a point farther than so many times the surface is hidden
SLACK = 0.25  # cuts may deviate from equal blocks by this share, to pass through a door
ROWS = 48  # of the grid of directions that margin cameras are masked by
NEIGHBOURS = 4  # points that decide to which block a direction belongs, by at least half
RIM = 2  # cells of that grid by which masks are wider, so that both sides of a border train on it
MARGIN = 0.04  # share of the sphere of a margin camera that its block fills at least
SEEN = 0.1  # share of the cameras of a block that see a point of another block which it begins with
REGIONS = "regions.npz"  # beside the blocks: points, and the block of each
BLOCK = "block.json"  # in each block: number, count, source, format and options of its loader, SHA-256 of the regions


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
        raise DataError(f"{capture.folder} has no point cloud, and blocks are made of cameras that share points")
    poses = {view_name(frame.name): frame.cam_from_world for frame in capture.frames}
    train, test = ([replace(v, cam_from_world=poses[v.name]) for v in side] for side in (scene.train, scene.test))
    if not 2 <= count <= len(train) // 2:
        raise DataError(f"--blocks is {count}; {len(train)} training views make 2 to {len(train) // 2} blocks")
    tracked = capture.tracks is not None and len(capture.tracks().frame) > 0
    step = 1 if tracked else max(1, math.ceil(len(capture.cloud.points) / SAMPLE))
    points = capture.cloud.points[::step].double()
    views, views_of_train = [*train, *test], np.arange(len(train))
    seen = visibility(capture, views, points)
    shared = csr_array(seen[: len(train)].astype(np.float32))
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


def split(source: Path, destination: Path, count: int, format: str, options: DataOptions) -> dict[Path, str]:
    """Write a data set for each block into a new folder; images are links. Return folder -> content of each block.

    Nothing is written if a DataError says that the source cannot be divided, or that the destination exists.
    """
    from scipy.spatial import KDTree

    if destination.exists():
        raise DataError(f"{destination} exists; nothing is overwritten: remove it, or name another folder with --to")
    capture = padgs.data.read(source, format, options)
    scene = assemble(capture, replace(options, cameras="panoramas"))
    blocks = plan(capture, scene, count)
    assert capture.cloud is not None, "refused by plan"
    points, colors = capture.cloud.points, capture.cloud.colors
    nearest = KDTree(blocks.points.numpy()).query(points.numpy())[1]
    frames = {view_name(frame.name): frame for frame in capture.frames}
    masks = {view.name: view.load_mask for view in (*scene.train, *scene.test)}
    given = {key: value for key, value in asdict(options).items() if key in ("images", "mask", "split", "dataset")}
    given["cameras"] = "panoramas"  # of the merged run too
    for key in ("images", "mask"):  # `padgs merge` may run elsewhere
        if given[key] and os.path.exists(given[key]) and not (source / given[key]).exists():
            given[key] = os.path.abspath(given[key])
    written = {}
    destination.parent.mkdir(parents=True, exist_ok=True)
    with draft_of(destination) as partial:
        partial.mkdir()
        np.savez(partial / REGIONS, points=blocks.points.numpy(), owner=blocks.owner.astype(np.int16))
        digest = hashlib.sha256((partial / REGIONS).read_bytes()).hexdigest()
        for number, core in enumerate(blocks.core):
            name = f"{scene.name}-block-{number + 1}"
            folder, final = partial / name, destination / name
            folder.mkdir()
            margin, held = blocks.margin[number], blocks.held[number]
            sides = {"train": [*core, *margin], "test": blocks.test[number]}
            views = [*sides["train"], *sides["test"]]
            for view in views:
                link, image = Path("images", frames[view.name].name), frames[view.name].image.resolve()
                (folder / link).parent.mkdir(parents=True, exist_ok=True)
                (folder / link).symlink_to(os.path.relpath(image, (final / link).parent.resolve()))
            kept = torch.from_numpy(blocks.used[number][nearest])
            shares = {name: round(sphere_share(part), 4) for name, part in held.items()}
            # Where the data set's format reduces wide images, the block does, and images have no size of their own.
            sizes = [(None, None) if capture.width else (v.width, v.height) for v in views]
            content = Content(
                frames=tuple(
                    replace(frames[v.name], width=width, height=height, share=shares.get(v.name, 1.0))
                    for v, (width, height) in zip(views, sizes, strict=True)
                ),
                cloud=Cloud(points[kept], None if colors is None else colors[kept]),
                tracks=None,
                split={side: tuple(frames[v.name].name for v in part) for side, part in sides.items() if scene.test},
            )
            write_transforms(content, folder)
            within = {view.name: partial_mask(view, held[view.name]) for view in (*core, *margin) if view.name in held}
            write_depths(views, folder)
            write_masks({view.name: within.get(view.name, masks[view.name]) for view in views}, folder)
            masks_meant = {"mask": "masks"} if (folder / "masks").is_dir() else {}  # they hide most of a view
            more = masks_meant | ({REDUCED: capture.width} if capture.width else {})
            described = json.loads((file := folder / "transforms.json").read_text(encoding="utf-8"))
            file.write_text(json.dumps(described | more, ensure_ascii=False), encoding="utf-8")
            block = {"number": number, "count": count, "format": format, "options": given, "regions": digest}
            block["source"] = os.path.relpath(source.resolve(), final.resolve())
            (folder / BLOCK).write_text(json.dumps(block, indent=1))
            parts = f"{len(core)} training views, {len(margin)} in the margin, {len(blocks.test[number])} test views"
            written[final] = f"{parts}, {int(kept.sum())} points"
        os.replace(partial, destination)
    return written


def partial_mask(view: View, held: np.ndarray) -> Callable[[], Tensor]:
    """Return a function that loads the mask of a view, restricted to directions [ROWS, 2 ROWS]."""

    def load() -> Tensor:
        rows, columns = (
            torch.arange(size) * count // size
            for size, count in zip((view.height, view.width), held.shape, strict=True)
        )
        inside = torch.from_numpy(held)[rows][:, columns].float()
        mask = view.mask()
        return inside if mask is None else inside * mask

    return load


def merge(folders: Sequence[str], console: Console, *, data: str = "", device: str = "auto") -> Path:
    """Join the runs of all blocks into a run on the whole data set, and score that on all test views.

    `data` is the folder of the blocks, if it has moved since `split`. Runs of one method with other settings are joined
    with a note; the result has those of the first block.
    """
    loaded = [load_run(folder, device=device) for folder in folders]
    if data:
        paths = [Path(data) / _folder_of(run).name for run in loaded]
        loaded = [load_run(run.folder, data_path=path, device=device) for run, path in zip(loaded, paths, strict=True)]
    pairs = sorted(((_block_of(run), run) for run in loaded), key=lambda pair: pair[0]["number"])
    (block, first), runs, numbers = pairs[0], [run for _, run in pairs], [other["number"] for other, _ in pairs]
    for other, run in pairs:
        _refuse_other(run, first)
        if (other["regions"], other["count"]) != (block["regions"], block["count"]):
            raise ValueError(f"{run.folder} is of another division than {first.folder}; merge runs of one padgs split")
    for number in range(block["count"]):
        if numbers.count(number) != 1:
            trouble = "no run" if number not in numbers else "several runs"
            raise ValueError(f"block {number + 1} of {block['count']} has {trouble}; give one run of each block")
    if differing := sorted({key for run in runs for key in _differing(run, first)}):
        say(console, f"trained differently: {', '.join(differing)}; the merged run states those of {first.folder}")
    folder = _folder_of(first).resolve()
    whole = {"path": os.path.normpath(folder / block["source"]), "format": block["format"], **block["options"]}
    together = hashlib.sha256("".join(run.digest for run in runs).encode()).hexdigest()
    blocks = f"{block['count']} blocks{' mixed' if differing else ''}"
    config = replace(
        first.config,
        data=replace(first.config.data, **whole),
        variant=", ".join(filter(None, (first.config.variant, blocks))),
        labels=Labels(first.result.preset if first.result else first.config.method),
        run=replace(first.config.run, folder=str(first.folder.resolve().parent)),
        init=WarmStart(" ".join(str(run.folder) for run in runs), together),
    )
    scene = load_scene(config, start(config))
    store = RunStore.of(config, scene)
    if (before := store.result()) is not None and before.ok:
        show_result(before, store.path, console)
        return store.path
    with np.load(folder.parent / REGIONS, allow_pickle=False) as regions:
        state = _joined(runs, numbers, regions, scene)
    with store:
        method = build_method(config)
        method.load_state(state)
        store.prepare(config.values())
        ends = [run.result for run in runs if run.result is not None]
        times = {name: math.fsum(end.timing[name] for end in ends) for name in ("train_seconds", "cpu_seconds")}
        iterations = sum(end.iterations_done for end in ends)
        store.save(method, Progress(iterations, times["train_seconds"], times["cpu_seconds"], 1.0))
        size = method.size()
        result = replace(
            initial_result(config, scene, store.path.name),
            iterations=iterations,
            iterations_done=iterations,
            counts={**size.counts, "parameters": size.parameters},
            model_bytes=size.bytes,
            timing=times,
            peak_memory_bytes=max(end.peak_memory_bytes for end in ends),
        )
        result = store.finish(scored(config, scene, store, result, method) if scene.test else result)
    show_result(result, store.path, console)
    whole = (f"data.path={config.data.path}", "data.cameras=panoramas")
    refine = ["padgs-run", *whole, f"init={store.path}", "train.refine=true"]
    say(console, f"to join the blocks, with their other settings: {shlex.join(refine)}", "dim")
    return store.path


def _folder_of(run: LoadedRun) -> Path:
    """Return the folder of the data set of a run, which may be given as a file in it."""
    path = Path(run.config.data.path or "")
    return path.parent if path.suffix == ".json" else path


def _differing(run: LoadedRun, first: LoadedRun) -> set[str]:
    """Return the keys of settings of data, training and scores that differ between two runs."""
    ours, others = (dict(flat(other.config.values())) for other in (run, first))
    keys = {key for key in ours.keys() | others.keys() if ours.get(key) != others.get(key)}
    return {key for key in keys if key != "data.path" and not key.startswith("run.")}


def _block_of(run: LoadedRun) -> dict[str, Any]:
    """Return the description of the block of a run, which must be what the run was trained on."""
    folder = _folder_of(run)
    if run.config.data.path is None or not (folder / BLOCK).is_file():
        raise ValueError(
            f"{run.folder} is of no block: {folder / BLOCK} is missing; train what padgs split wrote, or, if it has "
            "moved, name the folder of the blocks with --data"
        )
    described, regions = read_json(folder / BLOCK), folder.parent / REGIONS
    block: dict[str, Any] = {key: described[key].whole() for key in ("number", "count")}
    block |= {key: described[key].text() for key in ("source", "format", "regions")}
    block["options"] = {key: option.value for key, option in described["options"].items().items()}
    if not regions.is_file() or hashlib.sha256(regions.read_bytes()).hexdigest() != block["regions"]:
        raise ValueError(f"{regions} is missing, or not that of {folder}; split the data set again")
    run.refuse_other_data()
    return block


def _refuse_other(run: LoadedRun, first: LoadedRun) -> None:
    """Refuse a run that did not end well, or that cannot be joined with the first one."""
    config, train = run.config, run.config.train
    troubles = {
        "did not end well; start it again": run.result is None or not run.result.ok,
        f"is of {config.method}, whose parts share parameters; merge explicit Gaussians": not isinstance(
            run.method.model, SplatModel
        ),
        "learned poses, exposures or a lens, which differ between blocks; leave them given": not (
            train.exposures == train.poses == train.lens == "given"
        ),
        "was trained under stress; merge runs without": bool(config.stress.title),
        f"has other settings of method or render than {first.folder}; train them alike": (
            (config.method, config.options, config.render)
            != (first.config.method, first.config.options, first.config.render)
        ),
    }
    for trouble, holds in troubles.items():
        if holds:
            raise ValueError(f"{run.folder} {trouble}")


def _joined(runs: Sequence[LoadedRun], numbers: Sequence[int], regions: Mapping[str, Any], scene: Scene) -> State:
    """Return the state of a model of all Gaussians that lie in the blocks of their runs, in the world of the scene."""
    from scipy.spatial import KDTree

    tree, owner, parts = KDTree(regions["points"]), regions["owner"], []
    for run, number in zip(runs, numbers, strict=True):
        state = run.method.state().of_model()
        means = state.tensors["splats/means"].double().cpu() + run.scene.origin.cpu()
        kept = torch.from_numpy(owner[tree.query(means.numpy())[1]] == number)
        of_rows = ("splats/", "statistics/", "filter/", "lengths")
        rows = {n: t[kept] for n, t in state.tensors.items() if n.startswith(of_rows)}
        rows["splats/means"] = (means[kept] - scene.origin.cpu()).to(state.tensors["splats/means"])
        parts.append(rows)
    stored = runs[0].method.state()
    model = stored.of_model()
    tensors = {**model.tensors, **{name: torch.cat([part[name] for part in parts]) for name in parts[0]}}
    if "cameras" in tensors:
        tensors["cameras"] = cameras_of(scene.train)
    values = model.values | {"scene_scale": scene.scale, "extent": scene.extent}
    values["active_degree"] = max(run.method.model.splats.active_degree for run in runs)
    values["supersampling"] = max(run.method.model.supersampling for run in runs)
    others = {name: tensor for name, tensor in stored.tensors.items() if name.startswith("random/")}
    return State({f"{MODEL}{n}": t for n, t in tensors.items()} | others, stored.values | {"model": values})
