"""Measure how time and memory of one iteration of padgs+ grow with Gaussians and with pixels.

    OMP_NUM_THREADS=1 python docs/growth.py

writes the table in docs/notes/growth.md in some minutes on an idle machine. Gaussians lie on the walls of a cube, as
large as their distance from the next, and the panoramas are noise; every size has a process of its own, whose memory is
counted above that of the smallest size.
"""

import json
import re
import statistics
import subprocess
import sys
from pathlib import Path

import numpy as np

GAUSSIANS = (25_000, 50_000, 100_000, 200_000, 400_000, 800_000)  # at 1024x512
WIDTHS = (256, 512, 1024, 2048)  # with 100 000 Gaussians
WIDTH, COUNT, TINY = 1024, 100_000, (64, 1000)
WARM_UP, ITERATIONS, VIEWS = 3, 10, 4
FOLDER = Path(__file__).resolve().parent


def measure(width: int, count: int) -> tuple[float, int]:
    """Return the median CPU seconds of an iteration, and the peak memory of this process in bytes."""
    import torch

    from padgs import Budget, make_method
    from padgs.clock import peak_memory
    from padgs.scene import Scene, View

    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(count, 3, generator=generator)
    points = 2 * directions / directions.abs().amax(-1, keepdim=True)
    colors = torch.randint(0, 256, (count, 3), generator=generator, dtype=torch.uint8)

    def view(number: int) -> View:
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, 3] = torch.rand(3, generator=generator) - 0.5
        pixels = torch.randint(0, 256, (width // 2, width, 3), generator=generator, dtype=torch.uint8)
        return View(str(number), pose, width, width // 2, load_pixels=lambda: pixels)

    scene = Scene("growth", tuple(map(view, range(VIEWS))), (), points, colors, fingerprint="")
    off = ("initial_per_pixel=null", "limit_per_pixel=null", "depth_init_per_pixel=0", "coarse_share=0")
    method = make_method("padgs_plus", *(f"method.{option}" for option in (*off, "sky_per_point=0", "sh_degree=2")))
    records = method.fit(scene, Budget(100_000))  # the first round of densification is far away
    times = [next(records).cpu_seconds for _ in range(WARM_UP + ITERATIONS)]
    assert method.model.counts()["gaussians"] == count, method.model.counts()
    return statistics.median(np.diff(times)[WARM_UP - 1 :]), peak_memory()["peak_memory_bytes"]


def measured(width: int, count: int) -> tuple[float, int]:
    """Return `measure` in a process of its own."""
    command = [sys.executable, __file__, "--one", str(width), str(count)]
    return tuple(json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout))


def series() -> dict[str, list[tuple[int, float, float]]]:
    """Return for Gaussians and pixels: (number, milliseconds, MB above the smallest size)."""
    least = measured(*TINY)[1]
    sizes = {"Gaussians": [(n, WIDTH, n) for n in GAUSSIANS], "pixels": [(w * w // 2, w, COUNT) for w in WIDTHS]}
    rows = {kind: [(n, *measured(w, c)) for n, w, c in chosen] for kind, chosen in sizes.items()}
    return {kind: [(n, 1e3 * seconds, (b - least) / 1e6) for n, seconds, b in found] for kind, found in rows.items()}


def exponent(found: list[tuple[int, float, float]], column: int) -> float:
    """Return p of the power law, number^p, that fits a column best."""
    numbers, values = (np.log([max(row[index], 1e-3) for row in found]) for index in (0, column))
    return float(np.polyfit(numbers, values, 1)[0])


def main() -> None:
    """Measure, and write the table."""
    if "--one" in sys.argv:
        print(json.dumps(measure(*map(int, sys.argv[-2:]))))
        return
    lines = ["| growing | number | CPU ms per iteration | memory, MB |", "|---|---|---|---|"]
    for kind, found in series().items():
        lines += [f"| {kind} | {number:,} | {ms:.0f} | {mb:.0f} |" for number, ms, mb in found]
        lines.append(f"| {kind} | exponent | {exponent(found, 1):.2f} | {exponent(found, 2):.2f} |")
    print(table := "\n".join(lines))
    page = FOLDER / "notes" / "growth.md"
    between = re.compile(r"(<!-- growth -->\n).*(<!-- end -->)", re.DOTALL)
    page.write_text(between.sub(lambda m: f"{m[1]}{table}\n{m[2]}", page.read_text()))


if __name__ == "__main__":
    main()
