"""What methods make of a scene: a test view as photographed, and as each of them draws it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from pandas import DataFrame
from PIL import Image

from padgs.reports import methods
from padgs.reports.charts.drawing import Chart, Tips, figure, lay_out, png, styled, svg
from padgs.reports.conditions import footnotes, refuse_mixture
from padgs.reports.frame import by_conditions
from padgs.reports.gathered import Gathered
from padgs.reports.pictures import picture_names, split
from padgs.results import file_name

COLUMNS = 3
WIDTH = 512  # pixels of a picture at most


def charts(gathered: Gathered) -> list[Chart]:
    """A sheet for each scene, resolution and length of whose runs the pictures are at hand; the first seed is enough.

    Raises:
        ReportError: results that must not stand together.
    """
    runs, found = gathered.chosen("gallery"), []
    runs = runs.loc[runs["ok"] & (runs["variant"] == "") & (runs["pictures"].map(picture_names).map(len) > 0)]
    for where, own in by_conditions(runs, "resolution", "length").items():
        refuse_mixture(own, gathered.request, where, ("protocol", "data"))
        own = own.sort_values("seed", kind="stable").drop_duplicates("preset")
        shared = sorted(set.intersection(*(set(picture_names(folder)) for folder in own["pictures"])))
        if shared:
            name = file_name(f"gallery_{own['place'].iloc[0].stem}_{own['resolution'].iloc[0]}_{own['length'].iloc[0]}")
            notes = footnotes({where: own}, gathered.request.protocol)
            found += _sheet(name, where, own, shared[len(shared) // 2], notes)
    return found


@styled
def _sheet(name: str, where: str, runs: DataFrame, view: str, notes: Sequence[str]) -> list[Chart]:
    """The photograph, and what each run makes of it, the best of this view first; nothing if none can be read."""
    shown: list[tuple[float, str, Image.Image]] = []  # higher numbers first
    for _, run in runs.iterrows():
        try:
            photograph, drawn, _ = split(run["pictures"] / view, 3)
        except OSError:
            continue  # a picture that a kill has cut
        if not shown:
            shown.append((math.inf, "photograph", photograph))
        psnr, title = run["view_psnr"].get(view), methods.title(run["preset"])
        shown.append((-math.inf, title, drawn) if psnr is None else (psnr, f"{title}: {psnr:.2f} dB", drawn))
    if not shown:
        return []
    shown.sort(key=lambda one: -one[0])
    made, axes = figure(COLUMNS, math.ceil(len(shown) / COLUMNS), 3.9, 2.2)
    for panel in axes.flat:
        panel.set(xticks=[], yticks=[])  # where axes are off their labels are laid out all the same
        panel.set_axis_off()
    for panel, (_, words, picture) in zip(axes.flat, shown, strict=False):
        picture.thumbnail((WIDTH, WIDTH))
        panel.imshow(picture)
        panel.set_title(words)
    what = f"{where}\ntest view {Path(view).stem}, with the PSNR of this view"
    lay_out(made, what)
    return [Chart(name, what, svg(made, name, Tips()), png(made), tuple(notes))]
