"""`padgs bench`: where does the time go, and how much of it has to?"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console


def bench(
    out: Annotated[str, typer.Option(help="folder for bench.json and bench.png")] = "runs/bench",
    quick: Annotated[bool, typer.Option(help="a few seconds, on next to nothing: does it work?")] = False,
    full: Annotated[bool, typer.Option(help="also 2048x1024 with a million Gaussians")] = False,
    threads: Annotated[int, typer.Option(help="0 for one on each core")] = 0,
    repeats: Annotated[int, typer.Option(help="of each measurement; 0 for the usual number")] = 0,
    seed: Annotated[int, typer.Option(help="of the Gaussians")] = 0,
    isas: Annotated[bool, typer.Option(help="also on each instruction set")] = False,
    device: Annotated[str, typer.Option(help="cpu, or cuda for the GPU: other stages, see padgs/bench/gpu.py")] = "cpu",
) -> None:
    """Measure training and rendering, stage by stage, against what this machine can do and what is asked."""
    import json
    from dataclasses import replace
    from pathlib import Path

    from rich.console import Console

    from padgs.bench.picture import stacked_bars
    from padgs.bench.report import QUICK, BenchOptions, measure_all
    from padgs.bench.tables import lines
    from padgs.results import replace_file

    console = Console(highlight=False)
    folder = Path(out)
    if device != "cpu":
        _bench_gpu(console, folder, device, quick, full, repeats, seed)
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)  # before minutes of measuring, not after
        options = QUICK if quick else BenchOptions()
        options = replace(
            options,
            sizes=(*options.sizes, "large") if full else options.sizes,
            threads=threads or None,
            repeats=repeats or options.repeats,
            seed=seed,
            isas=isas,
        )
        with console.status("measuring") as status:
            report = measure_all(options, lambda what: status.update(f"measuring {what}"))
        for line in lines(report):
            console.print(line)
        replace_file(folder / "bench.json", json.dumps(report, indent=1, allow_nan=False).encode())
        replace_file(folder / "bench.png", stacked_bars(report))
    except (OSError, RuntimeError, ValueError) as error:
        console.print(f"error: {error}", markup=False)
        raise typer.Exit(1) from error
    console.print(f"written: {folder / 'bench.json'}, {folder / 'bench.png'}", markup=False, soft_wrap=True)


def _bench_gpu(console: Console, folder: Path, device: str, quick: bool, full: bool, repeats: int, seed: int) -> None:
    import json

    import torch

    from padgs.bench.gpu import gpu_lines, measure_gpu
    from padgs.results import replace_file

    sizes = ("quick",) if quick else ("medium", "large") if full else ("medium",)
    count = repeats or (3 if quick else 50)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with console.status("measuring") as status:
            report = measure_gpu(
                sizes,
                torch.device(device),
                repeats=count,
                warm_up=min(10, count),
                seed=seed,
                progress=lambda what: status.update(f"measuring {what}"),
            )
        for line in gpu_lines(report):
            console.print(line)
        replace_file(folder / "bench_gpu.json", json.dumps(report, indent=1, allow_nan=False).encode())
    except (OSError, RuntimeError, ValueError) as error:
        console.print(f"error: {error}", markup=False)
        raise typer.Exit(1) from error
    console.print(f"written: {folder / 'bench_gpu.json'}", markup=False, soft_wrap=True)
