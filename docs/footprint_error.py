"""Writes the table of footprint errors into docs/projections.md and draws docs/footprint_error.png.

    python docs/footprint_error.py

Takes a minute or two. The numbers are those of `padgs.render.footprint_error`; tests compare the table with it.
"""

from __future__ import annotations

import re
from pathlib import Path

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt

from padgs.render.footprint_error import LATITUDES, SIGMAS, footprint_error

FOLDER = Path(__file__).resolve().parent
PROJECTIONS = ("erp", "tangent", "cubemap")
# The same quantity by another program, in percent.
REFERENCE = {
    "erp": {
        0.5: {0: 0, 45: 0.4, 70: 1.0, 85: 3.9, 89: 19.2},
        2: {0: 0.2, 45: 1.4, 70: 3.8, 85: 15.6, 89: 28.9},
        5: {0: 1.2, 45: 3.6, 70: 9.4, 85: 27.5, 89: 18.3},
        10: {0: 4.8, 45: 7.6, 70: 17.3, 85: 24.5, 89: 9.0},
    },
    "tangent": {sigma: {0: percent} for sigma, percent in ((0.5, 0.0), (2, 0.5), (5, 3.0), (10, 11.2), (20, 38.6))},
    "cubemap": {},
}


def markdown(errors: dict[str, list[list[float]]]) -> str:
    """One table, in percent; in brackets the other program's numbers."""
    lines = ["| projection | σ | " + " | ".join(f"{latitude:g}°" for latitude in LATITUDES) + " |"]
    lines.append("|---|---|" + "---|" * len(LATITUDES))
    for projection in PROJECTIONS:
        for sigma, row in zip(SIGMAS, errors[projection], strict=True):
            known = REFERENCE[projection].get(sigma, {})
            cells = [
                f"{100 * error:.1f}" + (f" ({known[latitude]:g})" if latitude in known else "")
                for latitude, error in zip(LATITUDES, row, strict=True)
            ]
            lines.append(f"| {projection} | {sigma:g}° | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def draw(errors: dict[str, list[list[float]]], path: Path) -> None:
    """Error over latitude, one panel for each projection, one line for each size."""
    figure, panels = plt.subplots(1, len(PROJECTIONS), figsize=(10, 3.4), sharey=True, constrained_layout=True)
    colors = matplotlib.colormaps["viridis"]
    for panel, projection in zip(panels, PROJECTIONS, strict=True):
        for index, (sigma, row) in enumerate(zip(SIGMAS, errors[projection], strict=True)):
            color = colors(0.9 * index / (len(SIGMAS) - 1))
            panel.plot(LATITUDES, [100 * error for error in row], "o-", ms=3, color=color, label=f"σ = {sigma:g}°")
        panel.set(title=projection, xlabel="latitude of the mean (degrees)", yscale="log", ylim=(0.01, 200))
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("error (% of the mass)")
    panels[-1].legend(loc="lower center", ncols=2, fontsize="small")
    figure.savefig(path, dpi=110)


def main() -> None:
    """Compute, write, draw."""
    errors = {
        projection: [[footprint_error(projection, sigma, latitude) for latitude in LATITUDES] for sigma in SIGMAS]
        for projection in PROJECTIONS
    }
    page = FOLDER / "projections.md"
    between = re.compile(r"(<!-- table -->\n).*(<!-- end -->)", re.DOTALL)
    page.write_text(between.sub(lambda found: found[1] + markdown(errors) + "\n" + found[2], page.read_text()))
    draw(errors, FOLDER / "footprint_error.png")


if __name__ == "__main__":
    main()
