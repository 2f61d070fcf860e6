"""All measurements of `padgs bench` as one dict for JSON, on the CPU and on a GPU alike, and as tables.

Times are in seconds.

schema      version of this layout
noise       worst: how far times are apart that should agree; on the CPU wall and CPU time, on a GPU the 95th percentile
            and the median of iterations; limit: the tolerated value
noisy       worst > limit: other programs ran meanwhile, and the numbers should not be published
machine     hardware, versions, commit and date (`padgs.clock.machine`), instruction set or GPU architectures
options     of the command
ceilings    arithmetic (FLOP/s), memory (byte/s), crowding: see `padgs.apps.bench.ceilings.Ceilings`
sizes       name -> one workload:
  width, height, gaussians (requested), views
  counters    of the renderer, with ratios, anchors and parameters
  stages      stage -> seconds in one iteration (least CPU seconds of all threads; of a GPU kernel the mean), on the CPU
              wall, and floor and bound for stages with a cost model; on a GPU calls
  floor       sum of the least seconds of the stages at the ceilings
  iteration   of `padgs.training.loop.Trainer`, {wall, cpu: {median, p95, min}}; iteration_1_thread on the CPU
  frame       decode and render without gradients
  peak_bytes  memory at the peak of frames and of training: of the process, or of torch's allocator on a GPU
"""

import dataclasses
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from rich import box
from rich.markup import escape
from rich.table import Table

from padgs import clock
from padgs.apps.bench.ceilings import add_floors, measure_ceilings
from padgs.apps.bench.stages import STAGES, WARM_UP, cpu_stages, device_stages
from padgs.apps.bench.workload import OPTIONS, SIZES, Size, Workload, build
from padgs.checks import check, check_known, printable
from padgs.files import check_place, write_atomically
from padgs.native import cpu, cuda
from padgs.render import Rendering, render

SCHEMA = 2
NOISE_LIMIT = 0.25
MANY_GAUSSIANS, FEW_REPEATS = 500_000, 3  # on the CPU: maximum repeats of workloads with so many Gaussians
MAX_STAGES = 20  # rows of a table; a GPU runs many short kernels


@dataclass(frozen=True)
class BenchOptions:
    """Sizes, device and repeats of the measurements."""

    sizes: tuple[str, ...] = ("small", "medium")
    repeats: int = 10
    device: str = "cpu"
    threads: int | None = None  # None: one per core that this process may use
    seed: int = 0
    ceiling_seconds: float = 0.4

    def __post_init__(self) -> None:
        check_known(self, device=("cpu", "cuda"))
        check(self, "at least 1", lambda value: value is None or value >= 1, "repeats", "threads")


QUICK = BenchOptions(sizes=("quick",), repeats=3, ceiling_seconds=0.05)


def measure_all(options: BenchOptions, file: Path, progress: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Measure and return the report described above.

    `progress` is called with what is being measured. The report is written to `file` after each size, too:
    a time limit then loses little. Raises OSError without the native library, and ValueError without the GPU.
    """
    device = torch.device(options.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda, but torch finds no GPU with a driver here; see docs/renderer.md")
    file.parent.mkdir(parents=True, exist_ok=True)
    check_place(file)
    with clock.threads(options.threads or clock.machine()["cores"]):
        progress("the ceilings of this machine")
        ceilings = measure_ceilings(device, options.ceiling_seconds)
        report: dict[str, Any] = {
            "schema": SCHEMA,
            "machine": {**clock.machine(device), "compiled_for": _compiled_for(device)},
            "options": dataclasses.asdict(options),
            "sizes": {},
        }
        for name in options.sizes:
            progress(f"size {name}")
            report["sizes"][name] = measure_size(SIZES[name], options, device)
            _write(report, file)
        ceilings = ceilings.best(measure_ceilings(device, options.ceiling_seconds))
    for size in report["sizes"].values():
        add_floors(size, ceilings)
    worst = max([ceilings.crowding, *map(_disagreement, report["sizes"].values())])
    noise = {"noise": {"worst": worst, "limit": NOISE_LIMIT}, "noisy": worst > NOISE_LIMIT}
    report = noise | report | {"ceilings": dataclasses.asdict(ceilings)}
    _write(report, file)
    return report


def _write(report: dict[str, Any], file: Path) -> None:
    write_atomically(file, json.dumps(report, indent=1, allow_nan=False).encode())


def measure_size(size: Size, options: BenchOptions, device: torch.device) -> dict[str, Any]:
    """Return the entry of a workload in the report, without floors."""
    on_cpu = device.type == "cpu"
    repeats = min(options.repeats, FEW_REPEATS) if on_cpu and size.gaussians >= MANY_GAUSSIANS else options.repeats
    clock.reset_peak_memory(device)
    work = build(size, options.seed).to(device)
    frame = clock.measure(lambda: _frame(work), repeats=repeats, device=device)
    peak = {"frame": _peak_bytes(device)}
    records = work.trainer().records()
    entry = {"frame": frame}
    entry["iteration"] = clock.measure(lambda: next(records), repeats=repeats, warm_up=WARM_UP, device=device)
    peak["training"] = _peak_bytes(device)
    if on_cpu:
        with clock.threads(1):
            entry["iteration_1_thread"] = clock.measure(lambda: next(records), repeats=repeats, warm_up=1)
    stages = cpu_stages(work, repeats) if on_cpu else device_stages(work, repeats, device)
    return {**dataclasses.asdict(size), "counters": _count(work), "stages": stages, **entry, "peak_bytes": peak}


def _disagreement(size: dict[str, Any]) -> float:
    """Return by how much times of a size are apart that agree on an idle machine."""
    if "iteration_1_thread" in size:
        return size["iteration_1_thread"]["wall"]["median"] / size["iteration_1_thread"]["cpu"]["median"] - 1
    return size["iteration"]["wall"]["p95"] / size["iteration"]["wall"]["median"] - 1


def _compiled_for(device: torch.device) -> str | None:
    if device.type == "cpu":
        return cpu.library().padgs_isa().decode()
    return cuda.library().padgs_cuda_architectures().decode() if cuda.available() else None


def _peak_bytes(device: torch.device) -> int:
    return clock.peak_memory(device)["peak_memory_bytes" if device.type == "cpu" else "peak_device_memory_bytes"]


def _frame(work: Workload) -> Rendering:
    with torch.no_grad():
        return render(work.model.decode(work.view).gaussians, work.view, OPTIONS)


def _count(work: Workload) -> dict[str, Any]:
    counted, pixels = _frame(work).counters, work.size.width * work.size.height
    return {
        "anchors": len(work.model),
        "parameters": sum(p.numel() for p in work.model.parameters()),
        **counted,
        "evaluated_per_pixel": counted["evaluated"] / pixels,
        "contributing_per_pixel": counted["contributing"] / pixels,
        "tiles_per_gaussian": counted["instances"] / max(1, counted["visible"]),
    }


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
    processor = escape(printable(machine["gpu"] or machine["cpu"]))
    yield (
        f"{processor}, {machine['threads']} threads, compiled for {machine['compiled_for']}; "
        f"commit {(machine['commit'] or '?')[:10]}\nceilings of {'the GPU' if machine['gpu'] else 'one thread'}: "
        f"{ceilings['arithmetic'] / 1e9:.0f} GFLOP/s, {ceilings['memory'] / 1e9:.1f} GB/s"
    )
    for name, size in report["sizes"].items():
        yield _stages(name, size, bool(machine["gpu"]))
        yield _counters(size)
    if not machine["gpu"]:
        yield "".join(f"  [dim]{stage.replace('_', ' ')}: {words}[/dim]\n" for stage, words in STAGES.items())


def _stages(name: str, size: dict[str, Any], on_gpu: bool) -> Table:
    title = f"{name}: one training iteration, {size['width']}x{size['height']}, ms"
    clocks = ("GPU", "calls") if on_gpu else ("CPU", "wall")
    table = Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD)
    for column in ("stage", *clocks, "floor", "of ceiling", "bound by"):
        table.add_column(column, justify="left" if column in ("stage", "bound by") else "right")
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
        f"  {c['anchors']:,} anchors, {c['gaussians']:,} Gaussians ({c['visible']:,} visible), {c['instances']:,} "
        f"instances = {c['tiles_per_gaussian']:.2f} tiles each\n"
        f"  pairs per pixel: {c['evaluated_per_pixel']:.1f} evaluated, {c['contributing_per_pixel']:.1f} contributing\n"
        f"  peak memory: {peak['frame'] / 1e6:.0f} MB for frames, {peak['training'] / 1e6:.0f} MB for training\n"
    )


def _share(timing: dict[str, Any]) -> str:
    return f"{timing['floor'] / timing['seconds']:.0%}" if timing["seconds"] else ""


def _ms(seconds: float) -> str:
    return f"{seconds * 1e3:.3f}"
