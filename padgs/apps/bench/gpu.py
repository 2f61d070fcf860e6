"""`padgs bench --device cuda`: frames and training iterations on a GPU, stage by stage, beside the published bounds.

Seconds of the device between two events, after warm-up rounds; host time that the device waits for is in the whole, not
in the stages. On the CPU, where tests run it, seconds of the wall clock.

schema      version of this layout
machine     `padgs.clock.machine` of the device; the compute capabilities of the library
ceilings    copy (byte/s of torch's own copy, read and written) and fp32 (FLOP/s of a matrix product without TF32)
sizes       name -> one workload of `padgs.apps.bench.workload`:
  ours, published, hybrid   bounds that are exact, squares of 3 sigma as published, and the exact with hybrid blending:
    counters        what the renderer counted
    frame           decode and draw, {"median", "p95", "min"} seconds
    decode          precision of the networks' products -> decode only, without gradients
    graph           frame as a CUDA graph: the host launches once and waits at its end; null without a GPU
    iteration       one iteration of `padgs.training.loop.Trainer`
    explicit        the same of as many explicit Gaussians with harmonics of degree 3
    stages          calls of libpadgs_cuda in one iteration -> the same
    waits           times that torch made the host wait for the device in one iteration; null without a GPU
    peak_bytes      of torch's allocator, in one iteration
  slower            median of the published bounds' frame and iteration over ours
  targets           name -> {"value", "limit", "met"}; limits are for an H100 or H200 and the large size
"""

from __future__ import annotations

import dataclasses
import warnings
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import torch

from padgs import clock
from padgs.apps.bench.on_device import OnDevice
from padgs.apps.bench.timeline import Timeline, calls_watched, timed
from padgs.apps.bench.workload import OPTIONS, SIZES, Size, build, refuse_unknown
from padgs.methods.anchors.precision import PRECISIONS
from padgs.native import cuda

SCHEMA = 1
MEASURED = {
    "ours": OPTIONS,
    "published": dataclasses.replace(OPTIONS, bounds="square", wrap=False),
    "hybrid": dataclasses.replace(OPTIONS, blending="hybrid"),
}
TITLES = {"ours": "exact bounds", "published": "published bounds", "hybrid": "exact bounds, hybrid blending"}
# For 1M Gaussians at 2048x1024 on an H100 or H200; at most, if not AT_LEAST.
LIMITS = {"frame_ms": 1.0, "iteration_ms": 3.5, "explicit_ms": 2.5, "peak_gb": 6.0, "published_slower": 2.0}
AT_LEAST = {"published_slower"}


def measure_gpu(
    sizes: tuple[str, ...],
    device: torch.device,
    *,
    repeats: int = 50,
    warm_up: int = 10,
    seed: int = 0,
    progress: Callable[[str], None] = lambda _: None,
    keep: Callable[[dict[str, Any]], None] = lambda _: None,
) -> dict[str, Any]:
    """Measure; the layout of the result is described above.

    Args:
        sizes, device, repeats, warm_up, seed: what is measured where, and how often.
        progress: is told what is being measured.
        keep: is given the result as far as it has come, after every workload.

    Raises:
        ValueError: an unknown size, or nothing to measure on.
    """
    refuse_unknown(sizes)
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda, but torch finds no GPU with a driver here; see docs/cuda.md")
    architectures = cuda.library().padgs_cuda_architectures().decode() if cuda.available() else None
    progress("the device's ceilings")
    report: dict[str, Any] = {
        "schema": SCHEMA,
        "machine": {**clock.machine(device), "compiled_for": architectures},
        "options": {"sizes": list(sizes), "repeats": repeats, "warm_up": warm_up, "seed": seed},
        "ceilings": measure_ceilings(device, megabytes=1024 if device.type == "cuda" else 8),
        "sizes": {},
    }
    for name in sizes:
        size = SIZES[name]
        report["sizes"][name] = entry = dict(dataclasses.asdict(size))
        for label, options in MEASURED.items():
            progress(f"{name}, {TITLES[label]}")
            entry[label] = _measure(OnDevice(build(size, seed), options, device), repeats, warm_up)
            keep(report)
        entry["slower"] = {
            part: entry["published"][part]["median"] / entry["ours"][part]["median"] for part in ("frame", "iteration")
        }
        entry["targets"] = _targets(size, entry)
        keep(report)
    return report


def measure_ceilings(device: torch.device, megabytes: int) -> dict[str, float]:
    """What torch itself gets out of the device."""
    line = Timeline(device)
    source = torch.empty(megabytes << 18, device=device)
    side = min(8192, 8 * megabytes)
    matrix = torch.randn(side, side, device=device)
    target, product = torch.empty_like(source), torch.empty_like(matrix)
    copy = timed(lambda: target.copy_(source), line, 10, 3)["min"]
    multiply = timed(lambda: torch.mm(matrix, matrix, out=product), line, 5, 2)["min"]
    return {"copy": 2 * 4 * source.numel() / copy, "fp32": 2 * side**3 / multiply}


def _measure(iteration: OnDevice, repeats: int, warm_up: int) -> dict[str, Any]:
    line = Timeline(iteration.device)
    frame = timed(iteration.frame, line, repeats, warm_up)
    decode = {name: timed(iteration.decoding(name), line, repeats, warm_up) for name in PRECISIONS}
    captured = iteration.captured_frame()
    graph = None if captured is None else timed(captured, line, repeats, warm_up)
    del captured  # and its memory
    explicit = timed(iteration.explicit(), line, repeats, warm_up)
    clock.reset_peak_memory(iteration.device)
    timing = timed(iteration.train, line, repeats, warm_up)
    memory = clock.peak_memory(iteration.device)
    return {
        "backend": iteration.backend,
        "frame": frame,
        "decode": decode,
        "graph": graph,
        "iteration": timing,
        "explicit": explicit,
        "stages": _stages(iteration, line, repeats),
        "waits": _waits(iteration),
        "counters": dict(iteration.frame().counters),
        "peak_bytes": memory["device"],
    }


def _waits(iteration: OnDevice) -> int | None:
    if iteration.device.type != "cuda":
        return None
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            iteration.train()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    return sum("synchronizing" in str(warning.message) for warning in caught)


def _stages(iteration: OnDevice, line: Timeline, repeats: int) -> dict[str, dict[str, float]]:
    rounds: list[defaultdict[str, float]] = []  # name -> seconds
    for _ in range(repeats):
        with calls_watched(line) as marks:
            iteration.train()
        clock.synchronise(line.device)
        rounds.append(defaultdict(float))
        for name, start, end in marks:
            rounds[-1][name] += line.seconds(start, end)
    return {name: clock.summary([spent[name] for spent in rounds]) for name in sorted(set().union(*rounds))}


def _targets(size: Size, entry: dict[str, Any]) -> dict[str, dict[str, Any]]:
    if size != SIZES["large"]:
        return {}
    ours = entry["ours"]
    values = {
        "frame_ms": 1e3 * ours["frame"]["median"],
        "iteration_ms": 1e3 * ours["iteration"]["median"],
        "explicit_ms": 1e3 * ours["explicit"]["median"],
        "peak_gb": None if ours["peak_bytes"] is None else ours["peak_bytes"] / 1e9,
        "published_slower": min(entry["slower"].values()),
    }
    targets = {}
    for name, value in values.items():
        met = value is not None and (value >= LIMITS[name] if name in AT_LEAST else value <= LIMITS[name])
        targets[name] = {"value": value, "limit": LIMITS[name], "met": met}
    return targets


def gpu_lines(report: dict[str, Any]) -> list[str]:
    """The report for people."""
    machine, ceilings = report["machine"], report["ceilings"]
    found = [
        f"{machine['gpu'] or machine['cpu']}: copies {ceilings['copy'] / 1e9:.0f} GB/s, multiplies "
        f"{ceilings['fp32'] / 1e12:.2f} TFLOP/s in fp32"
    ]
    for name, size in report["sizes"].items():
        found.append(f"{name}: {size['width']}x{size['height']}, about {size['gaussians']:,} Gaussians")
        for label, title in TITLES.items():
            part = size[label]
            peak = "" if part["peak_bytes"] is None else f", {part['peak_bytes'] / 1e9:.2f} GB"
            times = (f"{what} {1e3 * part[what]['median']:.2f} ms (p95 {1e3 * part[what]['p95']:.2f})"
                     for what in ("frame", "iteration"))  # fmt: skip
            found.append(f"  {title}, backend {part['backend']}: {', '.join(times)}{peak}")
            if part["waits"] is not None:
                found.append(f"    the host waits {part['waits']} times in an iteration")
            if part["graph"] is not None:
                found.append(f"    frame as a CUDA graph: {1e3 * part['graph']['median']:.2f} ms")
            found.append(f"    iteration of explicit Gaussians: {1e3 * part['explicit']['median']:.2f} ms")
            decoded = (f"{1e3 * timing['median']:.2f} ms in {name}" for name, timing in part["decode"].items())
            found.append(f"    decoded only: {', '.join(decoded)}")
        found += [f"    {stage}: {1e3 * timing['median']:.3f} ms" for stage, timing in size["ours"]["stages"].items()]
        for target, verdict in size["targets"].items():
            found.append(f"  {target}: {verdict['value']} (asked: {verdict['limit']}), met: {verdict['met']}")
    return found
