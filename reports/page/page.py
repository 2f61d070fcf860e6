"""All reports in one file that needs no network: tables that sort, charts, test views and a 360° viewer."""

import base64
import io
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pandas import DataFrame
from PIL import Image

from padgs.reports import REPORTS
from padgs.reports.build import PAPER_COLUMNS
from padgs.reports.charts.drawing import Chart
from padgs.reports.frame import by_place
from padgs.reports.published import TITLES
from padgs.reports.selection import RunSet, Setting, settings
from padgs.reports.store import render_names, split_image
from padgs.reports.table import Block, Cell, Column, ReportError, Table
from padgs.reports.writers import rendered, rows_of

HERE = Path(__file__).resolve().parent
SCRIPTS = ("pannellum.js", "tablesort.min.js", "tablesort.number.min.js", "img-comparison-slider.js")
STYLES = ("pannellum.css", "img-comparison-slider.css")
IMAGE_WIDTH = 1024  # maximum pixels of an embedded panorama
JPEG_QUALITY = 80
CHARTS = ("equal_time_chart", "chart", "smallest_chart")  # of speed against accuracy
MAX_VIEWS = 3  # per scene
MAX_FILES = 90  # renders opened for a page; scenes that no longer fit are left out and named


@dataclass
class Album:
    """Test views of scenes, and the images that they refer to by number."""

    images: list[str] = field(default_factory=list)  # JPEG in base64
    scenes: list[dict[str, Any]] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)

    def add(self, image: Image.Image, width: int = IMAGE_WIDTH) -> int:
        """Keep an image of at most `width` pixels and return its number."""
        if image.width > width:
            image = image.resize((width, round(width * image.height / image.width)), Image.Resampling.BOX)
        file = io.BytesIO()
        image.convert("RGB").save(file, "JPEG", quality=JPEG_QUALITY)
        self.images.append(base64.b64encode(file.getvalue()).decode())
        return len(self.images) - 1


def html(run_set: RunSet) -> str:
    """Return the page with all other reports; a refused report is named at the top."""
    made, refused = {name: list[Any]() for name in REPORTS}, list[str]()
    for name in (name for name in REPORTS if name not in ("html", "gallery")):
        try:
            report = run_set.report(name)
            made[name] = report if isinstance(report, list) else [report]
        except ReportError as error:
            refused.append(str(error))
    tables = [_measured(part) for parts in made.values() for part in parts if isinstance(part, Table)]
    views = album(run_set)
    scenes = {"images": views.images, "scenes": views.scenes, "sets": _scene_sets(run_set.requested)}
    return rendered(
        "page/page.html.j2",
        summary=_summary(run_set.requested),
        facts=_facts(run_set.requested),
        problems=[*run_set.left_out, *refused, *run_set.warnings],
        tables=sorted((table for table in tables if table.blocks), key=lambda table: table.name != "equal_time"),
        rows_of=rows_of,
        spans=_spans,
        maps=_charts(made["stability"]),
        charts=_charts([part for name in CHARTS for part in made[name]]),
        sweeps=_charts(made["sweep"]),
        views=views,
        data=json.dumps(scenes).replace("<", "\\u003c"),  # no end of script
        styles="\n".join([*(_vendored(name) for name in STYLES), (HERE / "page.css").read_text("utf-8")]),
        scripts=[*(_vendored(name) for name in SCRIPTS), (HERE / "page.js").read_text("utf-8")],
        notice=_vendored("NOTICE.md"),
    )


def album(run_set: RunSet) -> Album:
    """Return a few views of each scene, of all settings of methods and rows of ablations; one seed is enough."""
    runs, parts = run_set.chosen("table1"), run_set.chosen("table3")
    own = pd.concat([runs, parts.loc[parts["variant"] != ""]]).drop_duplicates("run")
    own = own.loc[own["ok"] & ~own["stopped"].astype(bool) & (own["renders"].map(render_names).map(len) > 0)]
    groups = {place: sorted(settings(runs), key=_mean_psnr, reverse=True) for place, runs in by_place(own).items()}
    groups = dict(sorted(groups.items(), key=lambda group: bool(group[0].dataset)))  # the user's captures first
    count = min(MAX_VIEWS, max(1, MAX_FILES // max(1, sum(map(len, groups.values())))))
    made, opened = Album(), 0
    for place, shown in groups.items():
        every = render_names(shown[0].runs["renders"].iloc[0])
        even = np.linspace(0, len(every) - 1, count).round().astype(int)  # so that a path is seen from its whole length
        names = [every[number] for number in dict.fromkeys(even)]
        opened += len(shown) * len(names)
        if opened > MAX_FILES:
            made.left_out.append(place.title)
            continue
        views = [view for name in names if (view := _view(made, shown, name, run_set.warnings))["methods"]]
        if views:
            made.scenes.append({"title": place.title, "views": views})
    return made


def _mean_psnr(setting: Setting) -> float:
    known = [psnr for views in setting.runs["view_psnr"] for psnr in views.values()]
    return sum(known) / len(known) if known else -math.inf


def _view(made: Album, shown: Sequence[Setting], name: str, warnings: list[str]) -> dict[str, Any]:
    view: dict[str, Any] = {"title": Path(name).stem, "truth": None, "methods": []}
    for setting in shown:
        runs = setting.runs.loc[[(folder / name).is_file() for folder in setting.runs["renders"]]]
        if runs.empty:
            continue
        run = runs.iloc[0]
        try:
            truth, render, error = split_image(run["renders"] / name, 3)
        except OSError as error:  # such as an incomplete file of a killed run
            warnings.append(f"a picture is left out: {error}")
            continue
        if view["truth"] is None:
            view["truth"], view["panorama"] = made.add(truth), truth.width == 2 * truth.height
        images = {"render": made.add(render), "error": made.add(error, IMAGE_WIDTH // 2)}
        psnr = run["view_psnr"].get(name)
        metric = "" if psnr is None else f", PSNR {psnr:.2f} dB"
        view["methods"].append({"title": f"{setting.title}{metric}", **images})
    return view


def _summary(runs: DataFrame) -> str:
    counts = f"{runs['scene'].nunique()} scenes, {runs['preset'].nunique()} methods"
    versions = f"{runs['code_version'].nunique()} versions of the code"
    return f"{len(runs)} runs, of which {(~runs['ok']).sum()} failed; {counts}, {versions}"


def _facts(runs: DataFrame) -> list[tuple[str, str]]:
    columns = {"Scenes": "scene", "Methods": "preset", "Code": "code_version", "Machines": "hardware"}
    facts = [(name, ", ".join(sorted(runs[column].unique()))) for name, column in columns.items()]
    return [*facts, ("Last run", max(runs["finished"], default="none"))]


def _scene_sets(runs: DataFrame) -> dict[str, list[str]]:
    """Return title -> names of scenes: those not tuned on and tuned on, each data set, and each scene."""
    sets: dict[str, list[str]] = {}
    for place in by_place(runs):
        for title in filter(None, (place.seen, TITLES.get(place.dataset, place.dataset))):
            sets.setdefault(title, [title] if title in TITLES.values() else []).append(place.scene)
    return sets | {place.heading: [place.scene] for place in by_place(runs)}


def _measured(table: Table) -> Table:
    """Return a table without the blocks that have only published numbers."""

    def has_ours(block: Block) -> bool:
        ours = [index for index, one in enumerate(block.own_columns or table.columns) if one.title not in PAPER_COLUMNS]
        return any(row.cells[index] != Cell() for row in block.rows for index in ours)

    return replace(table, blocks=tuple(filter(has_ours, table.blocks)))


def _spans(columns: Sequence[Column]) -> list[tuple[str, int]]:
    """Return heading and width of groups of columns; none if no group has several."""
    groups = [(group, len(list(own))) for group, own in groupby(columns, lambda column: column.group)]
    return groups if any(size > 1 for _, size in groups) else []


def _charts(parts: Sequence[Any]) -> list[dict[str, Any]]:
    charts = [part for part in parts if isinstance(part, Chart)]
    return [{"title": one.title, "png": base64.b64encode(one.png).decode(), "notes": one.notes} for one in charts]


def _vendored(name: str) -> str:
    return (HERE / "vendor" / name).read_text("utf-8")
