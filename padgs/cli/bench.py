"""`padgs bench`: the time of each stage of training, beside the least time at this machine's ceilings."""

from typing import Annotated

import typer

from padgs.cli.errors import MAX_SEED, MAX_THREADS, check_range, name_place, show


def bench(
    out: Annotated[str, typer.Option(help="folder for bench.json")] = "runs/bench",
    quick: Annotated[bool, typer.Option(help="measure a tiny workload in seconds, to see that it works")] = False,
    full: Annotated[bool, typer.Option(help="also measure 2048x1024 with a million Gaussians")] = False,
    threads: Annotated[int, typer.Option(help="number of threads; 0: one per core")] = 0,
    repeats: Annotated[int, typer.Option(help="repetitions of each measurement; 0: 10 on the CPU, 50 on a GPU")] = 0,
    seed: Annotated[int, typer.Option(help="random seed of the Gaussians")] = 0,
    device: Annotated[str, typer.Option(help="cpu or cuda")] = "cpu",
) -> None:
    """Measure training and rendering, stage by stage, against the ceilings of this machine."""
    from dataclasses import replace
    from pathlib import Path

    from rich.console import Console

    from padgs.apps.bench.report import QUICK, BenchOptions, lines, measure_all

    check_range(0, MAX_THREADS, threads=threads)
    check_range(0, 10_000, repeats=repeats)
    check_range(0, MAX_SEED, seed=seed)
    usual = QUICK if quick else BenchOptions(repeats=10 if device == "cpu" else 50)
    sizes = (*usual.sizes, "large") if full else usual.sizes
    counts = {"threads": threads or None, "repeats": repeats or usual.repeats}
    options = replace(usual, sizes=sizes, device=device, seed=seed, **counts)
    file, console = Path(out) / "bench.json", Console(highlight=False)
    with console.status("measuring") as status, name_place(file, "--out"):
        report = measure_all(options, file, lambda what: status.update(f"measuring {what}"))
    for line in lines(report):
        console.print(line)
    show(f"written: {file}")
