"""`padgs bench`: where does the time go, and how much of it has to?"""

from __future__ import annotations

from typing import Annotated, Any

import typer

from padgs.cli.refusing import refusing


@refusing(OSError, RuntimeError, ValueError)
def bench(
    out: Annotated[str, typer.Option(help="folder for bench.json and bench.png")] = "runs/bench",
    quick: Annotated[bool, typer.Option(help="a few seconds, on next to nothing: does it work?")] = False,
    full: Annotated[bool, typer.Option(help="also 2048x1024 with a million Gaussians")] = False,
    threads: Annotated[int, typer.Option(help="0 for one on each core")] = 0,
    repeats: Annotated[int, typer.Option(help="of each measurement; 0 for the usual number")] = 0,
    seed: Annotated[int, typer.Option(help="of the Gaussians")] = 0,
    isas: Annotated[bool, typer.Option(help="also on each instruction set")] = False,
    device: Annotated[
        str, typer.Option(help="cpu, or cuda for the GPU: other stages, see padgs/apps/bench/gpu.py")
    ] = "cpu",
) -> None:
    """Measure training and rendering, stage by stage, against what this machine can do and what is asked."""
    import json
    from dataclasses import replace
    from functools import partial
    from pathlib import Path

    import torch
    from rich.console import Console

    from padgs.apps.bench.gpu import gpu_lines, measure_gpu
    from padgs.apps.bench.picture import stacked_bars
    from padgs.apps.bench.report import QUICK, BenchOptions, measure_all
    from padgs.apps.bench.tables import lines
    from padgs.replacing import replace_file

    def as_json(report: dict) -> bytes:
        return json.dumps(report, indent=1, allow_nan=False).encode()

    folder, console = Path(out), Console(highlight=False)
    folder.mkdir(parents=True, exist_ok=True)  # before minutes of measuring, not after
    measure: Any
    if device == "cpu":
        usual = QUICK if quick else BenchOptions()
        sizes = (*usual.sizes, "large") if full else usual.sizes
        repeats = repeats or usual.repeats
        options = replace(usual, sizes=sizes, threads=threads or None, repeats=repeats, seed=seed, isas=isas)
        measure, shown, written = partial(measure_all, options), lines, [folder / "bench.json", folder / "bench.png"]
    else:
        sizes = ("quick",) if quick else ("medium", "large") if full else ("medium",)
        repeats = repeats or (3 if quick else 50)
        where = torch.device(device)
        shown, written = gpu_lines, [folder / "bench_gpu.json"]

        def keep(report: dict) -> None:  # what has been measured when somebody, or a time limit, ends it
            replace_file(written[0], as_json(report))

        measure = partial(measure_gpu, sizes, where, repeats=repeats, warm_up=min(10, repeats), seed=seed, keep=keep)
    with console.status("measuring") as status:
        report = measure(progress=lambda what: status.update(f"measuring {what}"))
    for line in shown(report):
        console.print(line)
    for path in written:
        replace_file(path, stacked_bars(report) if path.suffix == ".png" else as_json(report))
    print(f"written: {', '.join(map(str, written))}")
