"""Pictures of test views for the page: truth, renders and errors of each scene, small enough to lie in one file."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from PIL import Image

from padgs.results import Result
from reports.request import Request
from reports.scenes import at, places
from reports.settings import Setting, chosen, settings

FOLDER = "renders"  # of a run: truth | render | error of each test view, side by side
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


def album(folder: Path, results: Sequence[Result], request: Request) -> Album:
    """Each setting of the methods, and the rows of ablations, on a few views of each scene; one seed is enough."""
    own = [*chosen(results, "table1", request), *(r for r in chosen(results, "table3", request) if r.variant)]
    seen = list({result.run: result for result in own if _files(folder, result)}.values())
    groups = {place: settings(at(place, seen)) for place in places(seen)}
    views = min(VIEWS, max(1, MOST_FILES // max(1, sum(map(len, groups.values())))))
    made, opened = Album(), 0
    for place, runs in groups.items():
        names = _spread(_files(folder, runs[0].runs[0]), views)
        opened += len(runs) * len(names)
        if opened > MOST_FILES:
            made.left_out.append(place.title)
            continue
        shown = [view for name in names if (view := _view(made, folder, runs, name))["methods"]]
        if shown:
            made.scenes.append({"title": place.title, "views": shown})
    return made


def _view(made: Album, folder: Path, runs: Sequence[Setting], name: str) -> dict[str, Any]:
    view: dict[str, Any] = {"title": Path(name).stem, "truth": None, "methods": []}
    for setting in runs:
        run = next((run for run in setting.runs if (folder / run.run / FOLDER / name).is_file()), None)
        if run is None:
            continue
        try:
            with Image.open(folder / run.run / FOLDER / name) as picture:
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


def _files(folder: Path, run: Result) -> list[str]:
    return sorted(path.name for path in (folder / run.run / FOLDER).glob("*.png"))


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
            if re.sub(r"[^A-Za-z0-9._-]+", "-", view) == Path(name).stem and value is not None:
                return f" ({value:.2f} dB)"
    return ""
