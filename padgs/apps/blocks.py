"""A large capture as blocks: `split` writes a data set per block, `merge` joins the models trained on them.

`padgs.apps.block_plan` divides. The cameras of a block and of its margin are masked to what belongs to it and a rim
around that, and drawn in proportion to what that leaves. A merged model has of each run the Gaussians that lie in its
block.
"""

import hashlib
import json
import math
import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial, reduce
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from torch import Tensor

import padgs.data
from padgs.apps.block_plan import plan, sphere_share
from padgs.data.assemble import assemble
from padgs.data.capture import Cloud, DataError, DataOptions, listed, view_name
from padgs.data.depths import write_depths
from padgs.data.formats.json_file import read_json
from padgs.data.formats.transforms import REDUCED
from padgs.data.formats.writers import Content, write_transforms
from padgs.data.masks import write_masks
from padgs.files import draft_of, given_path
from padgs.methods.splats.model import SplatModel
from padgs.methods.splats.smoothing_filter import cameras_of
from padgs.results import flat
from padgs.runs.console import say, show_result
from padgs.runs.load import KEYWORDS, LoadedRun, load_run
from padgs.runs.run import build_method, initial_result, load_scene, scored, start, then
from padgs.runs.store import Labels, Progress, RunStore
from padgs.runs.warm_start import WarmStart
from padgs.scene import Scene, View
from padgs.training.model import MODEL, State

REGIONS = "regions.npz"  # beside the blocks: points, and the block of each
KEPT = ("images", "mask", "points", "depth", "split", "dataset")  # options of the data that a merged run has, too
BLOCK = "block.json"  # in each block: number, count, source, format and options of its loader, SHA-256 of the regions


def split(
    source: Path, destination: Path, count: int, format: str, options: DataOptions
) -> tuple[dict[Path, str], tuple[str, ...]]:
    """Write a data set for each block into a new folder; images are links. Return folder -> content of each block,
    and notes on the source.

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
    given = {key: value for key, value in asdict(options).items() if key in KEPT}
    given["cameras"] = "panoramas"  # of the merged run too
    for key in ("images", "mask", "points"):  # `padgs merge` may run elsewhere
        _, inverted, name = (given[key] or "").rpartition("inverted:")
        if name not in KEYWORDS and (path := given_path(name, source)) != source / name:
            given[key] = f"{inverted}{path}"
    written = {}
    destination.parent.mkdir(parents=True, exist_ok=True)
    with draft_of(destination) as draft:
        draft.mkdir()
        np.savez(draft / REGIONS, points=blocks.points.numpy(), owner=blocks.owner.astype(np.int16))
        digest = hashlib.sha256((draft / REGIONS).read_bytes()).hexdigest()
        for number, core in enumerate(blocks.core):
            name = f"{scene.name}-block-{number + 1}"
            folder, final = draft / name, destination / name
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
            within = {v.name: partial(mask_within, v, held[v.name]) for v in (*core, *margin) if v.name in held}
            write_depths(views, folder)
            write_masks({view.name: within.get(view.name, masks[view.name]) for view in views}, folder)
            more: dict[str, Any] = {"mask": "masks"} if (folder / "masks").is_dir() else {}  # they hide most of a view
            more |= {REDUCED: capture.width} if capture.width else {}
            write_transforms(content, folder, **more)
            block = {"number": number, "count": count, "format": format, "options": given, "regions": digest}
            block["source"] = os.path.relpath(source.resolve(), final.resolve())
            (folder / BLOCK).write_text(json.dumps(block, indent=1))
            parts = f"{len(core)} training views, {len(margin)} in the margin, {len(blocks.test[number])} test views"
            written[final] = f"{parts}, {int(kept.sum())} points"
        os.replace(draft, destination)
    return written, scene.notes


def mask_within(view: View, held: np.ndarray) -> Tensor:
    """Return the mask of a view, restricted to directions [ROWS, 2 ROWS]."""
    sizes = zip((view.height, view.width), held.shape, strict=True)
    rows, columns = (torch.arange(size) * count // size for size, count in sizes)
    inside = torch.from_numpy(held)[rows][:, columns].float()
    mask = view.mask()
    return inside if mask is None else inside * mask


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
    if first.config.data.split == "all":  # nothing is left to score
        whole["split"] = "all"
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
    trained = {view.name for run in runs for view in run.scene.train}
    if leaks := [view.name for view in scene.test if view.name in trained]:
        raise ValueError(f"blocks were trained on test views of {scene.name}, {listed(leaks)}; restore its split")
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
        size, result = method.size(), initial_result(config, scene, store.path.name)
        chip = "gpu" if result.machine["gpu"] else "cpu"  # reports mix the result with none of one machine and version
        each = [(end.code_version, end.machine["gpu"] or end.machine["cpu"]) for end in ends]
        each.append((result.code_version, result.machine[chip]))
        code, place = (reduce(then, dict.fromkeys(of)) for of in zip(*each, strict=True))
        if any(end.machine["gpu"] for end in ends):
            del times["cpu_seconds"]  # says nothing of a GPU
        result = replace(
            result,
            code_version=code,
            machine={**result.machine, chip: place},
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
    config, other = run.config, first.config
    own, usual = config.data.split, "all" if other.data.split == "all" else "auto"
    is_explicit = isinstance(run.method.model, SplatModel)
    is_alike = (config.method, config.options, config.render) == (other.method, other.options, other.render)
    troubles = {
        "did not end well; start it again": run.result is None or not run.result.ok,
        f"is of {config.method}, whose parts share parameters; merge explicit Gaussians": not is_explicit,
        "learned poses, exposures or a lens, which differ between blocks; leave them given": run.method.calibrates,
        "was trained under stress; merge runs without": bool(config.stress.title),
        f"has data.split={own}, with other test views than the whole; train with auto, or all with all": own != usual,
        f"has other settings of method or render than {first.folder}; train them alike": not is_alike,
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
    others = {name: tensor for name, tensor in stored.tensors.items() if name.startswith("random/")}
    return State({f"{MODEL}{n}": t for n, t in tensors.items()} | others, stored.values | {"model": values})
