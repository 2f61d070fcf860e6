"""A report of `padgs bench` as tables for the terminal."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rich import box
from rich.table import Table

from padgs.apps.bench.stages import STAGES

MAX_STAGES = 20  # rows of a table; a GPU runs many short kernels


def lines(report: dict[str, Any]) -> Iterator[Table | str]:
    """Yield text and tables, the noise first."""
    machine, ceilings, noise = report["machine"], report["ceilings"], report["noise"]
    if report["noisy"]:
        yield (
            f"[bold red]NOISY[/bold red]: times that should agree differ by {noise['worst']:.0%} (tolerated: "
            f"{noise['limit']:.0%}), so other programs ran meanwhile. Repeat on an idle machine before publishing."
        )
    else:
        yield f"Times that should agree differ by at most {max(0.0, noise['worst']):.0%}."
    yield (
        f"{machine['gpu'] or machine['cpu']}, {machine['threads']} threads, compiled for {machine['compiled_for']}; "
        f"commit {(machine['commit'] or '?')[:10]}\nceilings of {'the GPU' if machine['gpu'] else 'one thread'}: "
        f"{ceilings['arithmetic'] / 1e9:.0f} GFLOP/s, {ceilings['memory'] / 1e9:.1f} GB/s"
    )
    for name, size in report["sizes"].items():
        yield _stages(name, size, bool(machine["gpu"]))
        yield _counters(size)
    if "tiles" in report:  # on the CPU
        yield "".join(f"  [dim]{stage.replace('_', ' ')}: {words}[/dim]\n" for stage, words in STAGES.items())
        yield _tiles(report["tiles"])


def _stages(name: str, size: dict[str, Any], on_gpu: bool) -> Table:
    title = f"{name}: one training iteration, {size['width']}x{size['height']}, ms"
    clocks = ("GPU", "calls") if on_gpu else ("CPU", "wall")
    table = _table(title, "stage", *clocks, "floor", "of ceiling", "bound by")
    for stage, timing in list(size["stages"].items())[:MAX_STAGES]:
        second = f"{timing['calls']:.0f}" if on_gpu else _ms(timing["wall"])
        cells = [_ms(timing["floor"]), _share(timing), timing["bound"]] if "floor" in timing else []
        table.add_row(stage.replace("_", " "), _ms(timing["seconds"]), second, *cells)
    table.add_section()
    whole = {"seconds": sum(stage["seconds"] for stage in size["stages"].values()), "floor": size["floor"]}
    table.add_row("all stages", _ms(whole["seconds"]), "", _ms(whole["floor"]), _share(whole))
    for key in ("iteration", "iteration_1_thread", "frame"):
        if key in size:
            used = "" if on_gpu else _ms(size[key]["cpu"]["min"])
            table.add_row(key.replace("_", " "), used, _ms(size[key]["wall"]["median"]))
    return table


def _counters(size: dict[str, Any]) -> str:
    c, peak = size["counters"], size["peak_bytes"]
    return (
        f"  {c['anchors']:,} anchors, {c['gaussians']:,} Gaussians ({c['visible']:,} visible, median size "
        f"{c['median_sigma']:.2f} px), {c['instances']:,} instances = {c['tiles_per_gaussian']:.2f} tiles each\n"
        f"  pairs per pixel: {c['evaluated_per_pixel']:.1f} evaluated, {c['contributing_per_pixel']:.1f} contributing\n"
        f"  peak memory: {peak['frame'] / 1e6:.0f} MB for frames, {peak['training'] / 1e6:.0f} MB for training\n"
    )


def _tiles(tiles: dict[str, Any]) -> Table:
    bands = list(tiles["exact"]["bands"])
    title = f"tiles per Gaussian by latitude, {tiles['width']}x{tiles['height']}, sigma {tiles['sigma']:g} px"
    table = _table(title, "bounds", "all", *(f"{band}\N{DEGREE SIGN}" for band in bands), "max")
    for name, words in (("exact", "exact"), ("square", "square, as published")):
        means = [tiles[name]["mean"], *(tiles[name]["bands"][band]["mean"] for band in bands)]
        table.add_row(words, *("-" if mean is None else f"{mean:.1f}" for mean in means), str(tiles[name]["max"]))
    return table


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD)
    for number, column in enumerate(columns):
        table.add_column(column, justify="left" if number == 0 or column == "bound by" else "right")
    return table


def _share(timing: dict[str, Any]) -> str:
    return f"{timing['floor'] / timing['seconds']:.0%}" if timing["seconds"] else ""


def _ms(seconds: float) -> str:
    return f"{seconds * 1e3:.3f}"
