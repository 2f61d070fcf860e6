"""Pictures of test views for the page: truth, renders and errors of each scene, small enough to lie in one file."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from PIL import Image

from padgs.results import Result, picture_name
from reports.request import Request
from reports.scenes import at, places
from reports.settings import Setting, chosen, settings
from reports.store import Run

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


def album(runs: Sequence[Run], request: Request) -> Album:
    """Each setting of the methods, and the rows of ablations, on a few views of each scene; one seed is enough."""
    results = [run.result for run in runs]
    folders = {run.result.run: run.pictures for run in runs if run.pictures is not None}
    own = [*chosen(results, "table1", request), *(r for r in chosen(results, "table3", request) if r.variant)]
    seen = list({result.run: result for result in own if _files(folders, result)}.values())
    groups = {place: settings(at(place, seen)) for place in places(seen)}
    views = min(VIEWS, max(1, MOST_FILES // max(1, sum(map(len, groups.values())))))
    made, opened = Album(), 0
    for place, shown_settings in groups.items():
        names = _spread(_files(folders, shown_settings[0].runs[0]), views)
        opened += len(shown_settings) * len(names)
        if opened > MOST_FILES:
            made.left_out.append(place.title)
            continue
        shown = [view for name in names if (view := _view(made, folders, shown_settings, name))["methods"]]
        if shown:
            made.scenes.append({"title": place.title, "views": shown})
    return made


def _view(made: Album, folders: Mapping[str, Path], runs: Sequence[Setting], name: str) -> dict[str, Any]:
    view: dict[str, Any] = {"title": Path(name).stem, "truth": None, "methods": []}
    for setting in runs:
        run = next((run for run in setting.runs if name in _files(folders, run)), None)
        if run is None:
            continue
        try:
            with Image.open(folders[run.run] / name) as picture:
                picture.load()
        except OSError:
            continue  # a picture that a kill has cut: the numbers do not depend on it
        width, height = picture.width // 3, picture.height
        truth, render, error = (picture.crop((i * width, 0, (i + 1) * width, height)) for i in range(3))
        if view["truth"] is None:
            view["truth"] = made.add(truth)
        images = {"render": made.add(render), "error": made.add(error, WIDTH // 2)}
        view["methods"].append({"title": f"{setting.title}{_mark(run, name)}", **images})
    return view


def _files(folders: Mapping[str, Path], run: Result) -> list[str]:
    return sorted(path.name for path in folders[run.run].glob("*.png")) if run.run in folders else []


def _spread(names: Sequence[str], count: int) -> list[str]:
    """So many of them from the first to the last, so that a walk is seen from more than one place.

    >>> _spread("abcde", 3), _spread("abcde", 1), _spread("ab", 3)
    (['a', 'c', 'e'], ['a'], ['a', 'b'])
    """
    if len(names) <= count:
        return list(names)
    return [names[round(i * (len(names) - 1) / max(1, count - 1))] for i in range(count)]


def _mark(run: Result, name: str) -> str:
    """The PSNR of the view, after the name of the method."""
    for scores in run.scores.values():
        for view, numbers in scores.views.items():
            value = numbers.get("psnr")
            if picture_name(view) == name and value is not None:
                return f" ({value:.2f} dB)"
    return ""
