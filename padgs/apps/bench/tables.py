"""A report of the bench as tables for the terminal."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rich import box
from rich.table import Table

from padgs.apps.bench.goals import REFERENCE_FMA
from padgs.apps.bench.stages import STAGES

WHOLE = {  # key of a size -> name, meaning
    "iteration": ("iteration", "undisturbed"),
    "iteration_1_thread": ("on 1 thread", "the same iteration"),
    "frame": ("frame", "decoded and drawn without gradients"),
    "render": ("draw and back", "fixed Gaussians, and their gradients"),
}


def lines(report: dict[str, Any]) -> Iterator[Table | str]:
    """What to print, in order."""
    machine, ceilings = report["machine"], report["ceilings"]
    yield (
        f"{machine['cpu']}, {machine['threads']} threads, {machine['isa']}; commit {(machine['commit'] or '?')[:10]}\n"
        f"ceilings of one thread while all run: {ceilings['fma']['per_cpu_second'] / 1e9:.0f} GFLOP/s, "
        f"{ceilings['triad']['per_cpu_second'] / 1e9:.1f} GB/s "
        f"(by the wall clock, together: {ceilings['fma']['per_second'] / 1e9:.0f} and "
        f"{ceilings['triad']['per_second'] / 1e9:.1f})"
    )
    for name, size in report["sizes"].items():
        yield _stages(name, size)
        yield _legend(size)
        yield _counters(size)
    yield _ratios(report)
    yield _bounds(report["bounds"])
    if "isas" in report:
        yield _isas(report["isas"])
    yield _targets(report)
    yield _verdict(report)


def _stages(name: str, size: dict[str, Any]) -> Table:
    table = _table(
        f"{name}: one training iteration, {size['width']}x{size['height']}, ms",
        *("stage", "CPU min", "CPU median", "wall min", "wall median", "floor", "of ceiling", "bound by"),
    )
    table.collapse_padding, table.columns[0].no_wrap, table.columns[-1].min_width = True, True, 10
    for stage, timing in size["stages"].items():
        floor = (
            [f"{timing['floor'] * 1e3:.3f}", f"{timing['fraction']:.0%}", timing["bound"]] if "floor" in timing else []
        )
        table.add_row(stage.replace("_", " "), *_times(timing), *floor)
    table.add_section()
    table.add_row("all but adapt", *_times(size["stage_sum"]), f"{size['floor'] * 1e3:.3f}")
    for key, (title, _) in WHOLE.items():
        table.add_row(title, *_times(size[key]))
    return table


def _legend(size: dict[str, Any]) -> str:
    stages = [(stage.replace("_", " "), STAGES[stage]) for stage in size["stages"]]
    return "".join(f"  [dim]{title}: {meaning}[/dim]\n" for title, meaning in (*stages, *WHOLE.values()))


def _counters(size: dict[str, Any]) -> str:
    c, peak = size["counters"], size["peak_bytes"]
    return (
        f"  {c['anchors']:,} anchors, {c['gaussians']:,} Gaussians ({c['visible']:,} visible, median size "
        f"{c['sigma']['p50']:.2f} px), {c['instances']:,} instances = {c['tiles_per_gaussian']:.2f} tiles each\n"
        f"  pairs per pixel: {c['evaluated_per_pixel']:.1f} evaluated, {c['contributing_per_pixel']:.1f} contributing; "
        f"blended {size['rates']['forward'] / 1e9:.2f} G/s a core, backward {size['rates']['backward'] / 1e9:.2f}\n"
        f"  memory: {peak['start'] / 1e6:.0f} MB before, {peak['frame'] / 1e6:.0f} drawing frames, "
        f"{peak['training'] / 1e6:.0f} training\n"
    )


def _ratios(report: dict[str, Any]) -> Table:
    table = _table("the same work in two ways", "slow", "fast", "CPU ratio", "wall ratio", "")
    for ratio in report["ratios"].values():
        notes = [f"{ratio[count]:.2f} x the {count}" for count in ("instances", "evaluated") if count in ratio]
        if "size" in ratio:
            width, height, gaussians = ratio["size"]
            notes.append(f"on {width}x{height}, {gaussians:,} Gaussians")
        names = ratio["slow"]["what"], ratio["fast"]["what"]
        table.add_row(*names, f"{ratio['cpu']:.2f}", f"{ratio['wall']:.2f}", ", ".join(notes))
    return table


def _bounds(bounds: dict[str, Any]) -> Table:
    bands = list(bounds["exact"]["bands"])
    table = _table(
        f"tiles per Gaussian, {bounds['width']}x{bounds['height']}, sigma {bounds['sigma']:g} px, by latitude",
        *("bounds", "all", *(f"{band}\N{DEGREE SIGN}" for band in bands), "max"),
    )
    for name, meaning in (("exact", "exact"), ("square", "square, as published")):
        means = [bounds[name]["mean"], *(bounds[name]["bands"][band]["mean"] for band in bands)]
        table.add_row(meaning, *("-" if mean is None else f"{mean:.1f}" for mean in means), str(bounds[name]["max"]))
    return table


def _isas(isas: dict[str, Any]) -> Table:
    table = _table("draw fixed Gaussians, and back, ms", "instruction set", *("CPU min", "CPU median", "wall min"))
    for name, timing in isas.items():
        table.add_row(name, *_times(timing)[:3])
    return table


def _targets(report: dict[str, Any]) -> Table:
    table = _table("targets", "what", "asked", "measured", "", "CPU / threads")
    for target in report["targets"]:
        limit = f"{'≥' if target['relation'] == 'at least' else '≤'} {target['limit']:g} {target['unit']}"
        measured = "not measured" if target["measured"] is None else f"{target['measured']:.3g} {target['unit']}"
        undisturbed = "" if target["undisturbed"] is None else f"{target['undisturbed']:.3g}"
        table.add_row(target["name"], limit, measured, _judgement(target), undisturbed)
    return table


def _judgement(target: dict[str, Any]) -> str:
    if target["met"] is None:
        return ""
    factor = target["factor"]
    return f"[green]met, {factor:.2f} x[/green]" if target["met"] else f"[red]missed, {1 / factor:.2f} x off[/red]"


def _verdict(report: dict[str, Any]) -> str:
    noise = report["noise"]
    handicap = REFERENCE_FMA / report["ceilings"]["fma"]["per_cpu_second"]
    text = f"The limits were set on a machine with {handicap:.2f} x the arithmetic of this one per core.\n"
    if report["noisy"]:
        return text + (
            f"[bold red]NOISY[/bold red]: wall time exceeds what the CPU time accounts for by {noise['worst']:.0%} "
            f"(tolerated: {noise['limit']:.0%}), so other programs had the processors. CPU times and ratios of them "
            "still mean something; do not publish the rest, and repeat it on an idle machine."
        )
    return text + f"Wall and CPU time agree within {max(0.0, noise['worst']):.0%}."


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD)
    for number, column in enumerate(columns):
        words = number == 0 or column in ("bound by", "fast", "")
        table.add_column(column, justify="left" if words else "right")
    return table


def _times(timing: dict[str, Any]) -> list[str]:
    return [f"{timing[c][which] * 1e3:.3f}" for c in ("cpu", "wall") for which in ("min", "median")]
