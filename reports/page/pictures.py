"""Pictures of test views for the page: truth, renders and errors of each scene, small enough to lie in one file."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd
from PIL import Image

from padgs.reports.frame import by_place
from padgs.reports.gathered import Gathered
from padgs.reports.pictures import picture_names, split
from padgs.reports.settings import Setting, settings

WIDTH = 1024  # pixels of an embedded panorama at most
QUALITY = 80  # of JPEG
VIEWS = 3  # of a scene at most
MOST_FILES = 90  # pictures opened for a page; a scene that no longer fits is left out and named


@dataclass
class Album:
    """What the page shows, and the images that it refers to by number."""

    images: list[str] = field(default_factory=list)  # JPEG in base64
    scenes: list[dict[str, Any]] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)

    def add(self, image: Image.Image, width: int = WIDTH) -> int:
        """Keep an image, reduced to so many pixels, and give its number."""
        if image.width > width:
            image = image.resize((width, round(width * image.height / image.width)), Image.Resampling.BOX)
        file = io.BytesIO()
        image.convert("RGB").save(file, "JPEG", quality=QUALITY)
        self.images.append(base64.b64encode(file.getvalue()).decode())
        return len(self.images) - 1


def album(gathered: Gathered) -> Album:
    """Each setting of the methods, and the rows of ablations, on a few views of each scene; one seed is enough."""
    methods, parts = gathered.chosen("table1"), gathered.chosen("table3")
    own = pd.concat([methods, parts.loc[parts["variant"] != ""]]).drop_duplicates("run")
    own = own.loc[own["pictures"].map(picture_names).map(len) > 0]
    groups = {place: _best_first(settings(runs)) for place, runs in by_place(own).items()}
    groups = dict(sorted(groups.items(), key=lambda group: bool(group[0].dataset)))  # one's own captures, then others
    views = min(VIEWS, max(1, MOST_FILES // max(1, sum(map(len, groups.values())))))
    made, opened = Album(), 0
    for place, shown in groups.items():
        names = _spread(picture_names(shown[0].runs["pictures"].iloc[0]), views)
        opened += len(shown) * len(names)
        if opened > MOST_FILES:
            made.left_out.append(place.title)
            continue
        pictured = [view for name in names if (view := _view(made, shown, name))["methods"]]
        if pictured:
            made.scenes.append({"title": place.title, "views": pictured})
    return made


def _best_first(shown: Sequence[Setting]) -> list[Setting]:
    """By the mean PSNR of all views and seeds; those without any at the end."""

    def mean(setting: Setting) -> float:
        known = [psnr for views in setting.runs["view_psnr"] for psnr in views.values()]
        return sum(known) / len(known) if known else -math.inf

    return sorted(shown, key=mean, reverse=True)


def _view(made: Album, shown: Sequence[Setting], name: str) -> dict[str, Any]:
    view: dict[str, Any] = {"title": Path(name).stem, "truth": None, "methods": []}
    for setting in shown:
        runs = setting.runs.loc[[(folder / name).is_file() for folder in setting.runs["pictures"]]]
        if runs.empty:
            continue
        run = runs.iloc[0]
        try:
            truth, render, error = split(run["pictures"] / name, 3)
        except OSError:
            continue  # a picture that a kill has cut: the numbers do not depend on it
        if view["truth"] is None:
            view["truth"] = made.add(truth)
        images = {"render": made.add(render), "error": made.add(error, WIDTH // 2)}
        psnr = run["view_psnr"].get(name)
        mark = "" if psnr is None else f", PSNR {psnr:.2f} dB"
        view["methods"].append({"title": f"{setting.title}{mark}", **images})
    return view


def _spread(names: Sequence[str], count: int) -> list[str]:
    """So many of them from the first to the last, so that a walk is seen from more than one place.

    >>> _spread("abcde", 3), _spread("abcde", 1), _spread("ab", 3)
    (['a', 'c', 'e'], ['a'], ['a', 'b'])
    """
    if len(names) <= count:
        return list(names)
    return [names[round(i * (len(names) - 1) / max(1, count - 1))] for i in range(count)]
