"""Results that nobody measured, for tests of tables and charts."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from padgs import results
from padgs.reports import published
from padgs.reports.build import table
from padgs.reports.frame import frame
from padgs.reports.selection import Request, RunSet
from padgs.reports.store import Run
from padgs.reports.table import Table
from padgs.results import Result, Scores

RULES = {"name": "paper", "lpips": "vgg", "lpips_inputs": "01", "bottom_crop": 0.0}

SPHERE_RULES = {"name": "sphere", "lpips": "alex", "lpips_inputs": "11", "bottom_crop": 0.0}
METHODS = ("egonerf", "op43dgs", "odgs", "omnigs", "spags", "padgs")


def result(
    variant: str = "full", *, psnr: float = 23.5, ssim: float = 0.81, lpips: float | None = 0.229, **others
) -> Result:
    marks = {"psnr": psnr, "ssim": ssim, "lpips_vgg_01": lpips}
    rules = RULES | {"bottom_crop": 65 / 1024 if others.get("dataset", "roam360") == "roam360" else 0.0}
    made = Result(
        run=f"bar_padgs_{variant}_{others.get('seed', 0)}",
        status="ok",
        method="padgs",
        preset="padgs",
        variant=variant,
        dataset="roam360",
        scene="bar",
        width=2048,
        height=1024,
        iterations=30_000,
        iterations_done=30_000,
        seed=0,
        code_version="0.1.0 abc",
        machine={"cores": 2, "cpu": "A & B_1", "torch": "2.13.0"},
        config_hash="c",
        fingerprint="f",
        finished="2026-11-21T00:00:00+00:00",
        scores={"paper": Scores(rules, marks, {"a": marks})},
        config={"train": {"iterations": 30_000}, "method": {"tau": 0.9}, "seed": 0},
    )
    if "method" in others:
        others.setdefault("preset", others["method"])
    return replace(made, **others)


def failed(variant: str, status: str, **others) -> Result:
    return replace(result(variant, **others), status=status, scores={}, reason="no more")


def data_set(dataset: str, methods: tuple[str, ...] = ("omnigs", "padgs"), seeds: int = 1) -> list[Result]:
    """A result for each scene, method and seed of a data set; PSNR is 20 dB + a bit per scene, method and seed."""
    scenes = published.scenes(published.load(), published.DATASETS[dataset])
    return [
        result(
            "",
            method=method,
            dataset=dataset,
            scene=scene,
            seed=seed,
            run=f"{scene}_{method}_{seed}",
            fingerprint=scene,
            psnr=20 + place + 0.5 * methods.index(method) + 0.1 * seed,
            ssim=0.7 + 0.01 * place + 0.005 * methods.index(method),
            lpips=0.4 - 0.01 * place,
            timing={"train_seconds": 3600.0, "render_ms_median": 40.0},
            counts={"gaussians": 100_000},
            model_bytes=24_000_000,
            peak_memory_bytes=2_500_000_000,
        )
        for place, scene in enumerate(scenes)
        for method in methods
        for seed in range(seeds)
    ]


def scored(psnr: float) -> dict[str, Scores]:
    """Marks under both protocols that hang together."""
    flat = {"psnr": psnr, "ssim": 0.5 + psnr / 80, "lpips_vgg_01": 0.8 - psnr / 50}
    sphere = {"psnr": psnr, "ws_psnr": psnr - 0.4, "ws_ssim": 0.5 + psnr / 80, "ws_lpips_alex": 0.7 - psnr / 50}
    views = {f"view{i}": flat for i in range(4)}
    return {"paper": Scores(RULES, flat, views), "sphere": Scores(SPHERE_RULES, sphere, views)}


def small(psnr: float, cost: float = 1.0, **others) -> Result:
    """A run of a built-in scene at the scale of a CPU."""
    scene = others.setdefault("scene", "synthetic-room")
    run = "_".join([scene, others.get("method", "padgs"), str(others.get("seed", 0)), f"{psnr:.4f}-{cost:.3f}"])
    own = {
        "run": run,
        "dataset": "synthetic",
        "width": 512,
        "height": 256,
        "iterations": 1500,
        "iterations_done": 1500,
        "fingerprint": scene,
        "config": {"train": {"iterations": 1500}, "method": {"tau": 0.9}, "seed": others.get("seed", 0)},
        "scores": scored(psnr),
        "timing": {"train_seconds": 100 * cost, "render_ms_median": 40 * cost},
        "counts": {"gaussians": int(50_000 * cost)},
        "model_bytes": int(5e6 * cost),
        "peak_memory_bytes": int(1e9 * cost),
    }
    return result("", **(own | others))


def external(psnr: float, label: str, **others) -> Result:
    """Scores of a model that another program made."""
    own = {
        "method": "external",
        "iterations": 1,
        "iterations_done": 0,
        "config": {"train": {"learning_rates": "run"}},
        "timing": {"render_ms_median": 30.0},
    }
    made = small(psnr, **(own | others))
    return replace(made, run=label, external={"program": "Brush", "version": "0.3", "label": label})


def of_experiment(
    name: str, psnr: float, *, train: dict | None = None, options: dict | None = None, **others
) -> Result:
    """A run of an experiment with some keys of `train` and `method`; its WS-PSNR is 0.4 dB below its PSNR."""
    preset, iterations, seed = (
        others.setdefault(k, v) for k, v in (("preset", "padgs"), ("iterations", 1500), ("seed", 0))
    )
    config = {"train": {"iterations": iterations, **(train or {})}, "method": options or {}, "seed": seed}
    made = small(psnr, method=preset.split("_")[0], experiments=(name,), config=config, **others)
    return replace(made, run="_".join(map(str, (name, made.scene, preset, iterations, train, options, seed))))


def at_equal_time(*scenes: str) -> list[Result]:
    """A run of 60 s of CPU time of three methods on each scene: 25, 26 and 27 dB, on later scenes 4 dB more each."""
    made = []
    for index, scene in enumerate(scenes):
        for n, preset in enumerate(("odgs", "omnigs", "spags")):
            one = of_experiment("equal_time", 25.0 + n + 4 * index, preset=preset, scene=scene, cost=1.0 + n)
            data = {"generator": {"scene": scene}} if index % 2 else {"path": scene}
            config = {**one.config, "data": data, "budget": {"seconds": 60.0, "clock": "cpu"}}
            done = 1500 if n else 500  # slow methods have fewer iterations, and are ranked
            made.append(replace(one, config=config, iterations=done, iterations_done=done))
    return made


def budgets(psnr: dict[tuple[str, int], float]) -> list[Result]:
    """Two runs of `capacity` for each method and limit, with this PSNR and 0.1 dB more."""
    made = []
    for (preset, count), quality in psnr.items():
        for seed in (0, 1):
            one = of_experiment("capacity", quality + 0.1 * seed, preset=preset, seed=seed)
            config = {**one.config, "budget": {"gaussians": count}}
            made.append(replace(one, run=f"{one.run}_{count}", config=config, counts={"gaussians": count - seed}))
    return made


def compared(scenes=("synthetic-room", "synthetic-outdoor"), seeds: int = 2) -> list[Result]:
    """All methods of the paper on some scenes; OP43DGS runs out of memory outdoors, as there."""
    made = []
    for place, scene in enumerate(scenes):
        for rank, method in enumerate(METHODS):
            for seed in range(seeds):
                cost = 0.5 + 0.3 * rank if rank else 8.0
                one = small(
                    22 + 0.8 * rank - place + 0.1 * seed,
                    cost,
                    scene=scene,
                    method=method,
                    seed=seed,
                    experiments=("all_methods@cpu",),
                )
                out = method == "op43dgs" and "outdoor" in scene
                made.append(replace(one, status="oom", scores={}, timing={}) if out else one)
    return made


def swept(
    key: str = "tau", values=(0.0, 0.5, 0.9, 1.0), scenes=("synthetic-room", "synthetic-outdoor"), seeds: int = 3
):
    """A sweep of one key of PaD-GS, best at its third value."""
    return [
        small(
            25 - place - 2 * abs(value - values[2]) / max(values) + 0.1 * seed,
            1 + value / max(values),
            scene=scene,
            seed=seed,
            experiments=(f"{key}@cpu",),
            config={"train": {"iterations": 1500}, "method": {"tau": 0.9, key: value}, "seed": seed},
        )
        for place, scene in enumerate(scenes)
        for value in values
        for seed in range(seeds)
    ]


def write(results_: list[Result], folder: Path, renders: bool = False) -> Path:
    """Run folders as `padgs-run` leaves them: result.json, log.jsonl, and renders if requested."""
    for one in results_:
        run = folder / one.run
        run.mkdir(parents=True)
        results.write(one, run)
        best = one.scores["paper"].metrics["psnr"] if "paper" in one.scores else None
        seconds = one.timing.get("train_seconds")
        if best and seconds:
            parts = range(1, 16)
            log = [{"iteration": 100 * i, "seconds": seconds * i / 15, "psnr": best - 8 / i} for i in parts]
            (run / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in log))
        if renders and one.ok:
            write_renders(one, run)
    return folder


def write_renders(one: Result, run: Path, width: int = 128) -> None:
    """truth | render | error of two views: a gradient, a shifted one, and their difference."""
    (run / "renders").mkdir()
    longitude = np.linspace(0, 1, width)[None, :].repeat(width // 2, 0)
    latitude = np.linspace(0, 1, width // 2)[:, None].repeat(width, 1)
    for view in range(2):
        truth = np.stack([longitude, latitude, 0.5 + 0.5 * np.sin(20 * longitude + view)], -1)
        render = np.roll(truth, 2, 1) * 0.95
        three = np.concatenate([truth, render, np.abs(truth - render)], 1)
        Image.fromarray((255 * three).astype("uint8")).save(run / "renders" / f"view{view}.png")


def run_set(results_: list[Result], **asked: Any) -> RunSet:
    """What a report is made from, of runs that left nothing but their results."""
    return RunSet(frame(map(Run, results_)), Request(**asked))


def builder(name: str):
    """A function that builds a table of `specs`, and refuses mixtures."""
    return partial(table, name=name)


def assert_apart(panel: Any, texts: list[Any]) -> None:
    """No name in a panel touches another one or leaves the axes."""
    boxes = [text.get_window_extent() for text in texts]
    inside = panel.get_window_extent().padded(0.5)
    assert all(inside.contains(*corner) for box in boxes for corner in (box.min, box.max))
    assert not any(first.overlaps(second) for n, first in enumerate(boxes) for second in boxes[:n])


def columns(table: Table) -> list[str]:
    return [column.title for column in table.columns]


def value(table: Table, block: str, row: str, column: str) -> float | None:
    rows = next(b.rows for b in table.blocks if b.title.startswith(block))
    return next(r for r in rows if r.title == row).cells[columns(table).index(column)].value
