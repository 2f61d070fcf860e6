"""What a person reads at the end of a search."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from padgs.runs.console import MISSING, number


def show(need: Mapping[str, Any], console: Console) -> None:
    """Print the need for each loss, the knee, and what it took to find them."""
    steps = need["steps"]
    table = Table("may lose", box=SIMPLE_HEAD)
    for column in (need["row"], "of all", "blended", "MB", "ms", "lost, dB", "test dB"):
        table.add_column(column, justify="right")
    rows = {"nothing": 0, **{f"{epsilon} dB": at for epsilon, at in need["needs"].items()}, "knee": need["knee"]}
    for title, at in rows.items():
        if at is None:
            table.add_row(title, *[MISSING] * 7)
            continue
        step = steps[at]
        share, size = f"{100 * step['rows'] / need['rows']:.0f} %", f"{step['bytes'] / 1e6:.2f}"
        quality = f"{step['loss']:.2f}", number("psnr", step["test_ws_psnr"])
        table.add_row(title, str(step["rows"]), share, str(step["blended"]), size, f"{step['frame_ms']:.1f}", *quality)
    console.print(table)
    kept = need["kept"]
    if made := need["degrees"].get(f"{kept['epsilon']:g}"):  # none of models without harmonics
        degree = made[0]["degree"] if kept["degree"] is None else kept["degree"]
        losses = ", ".join(f"{one['loss']:.2f} dB with {one['degree']}" for one in made[1:])
        console.print(
            f"Harmonics for {kept['epsilon']:g} dB: degree {degree} of {made[0]['degree']}"
            + (f"; it lost {losses}" if losses else "")
        )
    console.print(_files(need))
    forgotten = steps[0]["ws_psnr"] - [step for step in steps if step["kind"] != "prune"][-1]["ws_psnr"]
    console.print(
        f"{need['waste']} of {need['rows']} {need['row']} showed nowhere. Without its {len(need['calibration'])} "
        f"calibration views the whole model itself lost {forgotten:.2f} dB there. The search took "
        f"{need['seconds']:.0f} s, {need['cpu_seconds']:.0f} s of them on the CPU."
    )


def _files(need: Mapping[str, Any]) -> Table:
    table = Table(f"kept for {need['kept']['epsilon']:g} dB as", box=SIMPLE_HEAD)
    for column in ("MB", "lost, dB", "test dB"):
        table.add_column(column, justify="right")
    table.add_column()
    for file in need["files"]:
        quality = f"{file['loss']:.2f}", number("psnr", file["test_ws_psnr"])
        note = "smallest good one" if file["kept"] else "; ".join(file["objections"])
        table.add_row(file["file"], f"{file['bytes'] / 1e6:.2f}", *quality, note)
    return table
