"""A test view of each scene: the ground truth, and the render of each method above its error."""

import math
from pathlib import Path

import numpy as np
import pandas as pd
from pandas import DataFrame
from PIL import Image, ImageDraw, ImageFont

from padgs.reports import methods
from padgs.reports.charts.drawing import INK, PAPER, Chart, wrap_title
from padgs.reports.conditions import footnotes, sheets
from padgs.reports.selection import RunSet, one_setting
from padgs.reports.store import render_names, split_image

COLUMNS = 3
WIDTH, GAP, TITLE, FONT_SIZE, LETTER = 420, 12, 22, 14, 9  # pixels: of an image, between images, of lines and letters
BOX = Image.Resampling.BOX


def charts(run_set: RunSet) -> list[Chart]:
    """Return a sheet for each scene, resolution and length with renders of test views; one seed is enough."""
    runs, found = run_set.chosen("gallery"), []
    runs = runs.loc[runs["ok"] & (runs["variant"] == "") & (runs["renders"].map(render_names).map(len) > 0)]
    for name, where, own in sheets(runs, run_set.request, "gallery", ("protocol", "data")):
        alike = (one_setting(of, f"{where}, {methods.title(preset)}", "preset") for preset, of in own.groupby("preset"))
        own = pd.concat([of.head(1) for of in alike])
        shared = sorted(set.intersection(*(set(render_names(folder)) for folder in own["renders"])))
        if shared and (images := _images(own, view := shared[len(shared) // 2], run_set.warnings)):
            title = f"{where}\ntest view {Path(view).stem}, below each render its error, with the PSNR of this view"
            found.append(_sheet(name, title, images, tuple(footnotes({where: own}, run_set.request.protocol))))
    return found


def _images(runs: DataFrame, view: str, warnings: list[str]) -> list[tuple[str, Image.Image]]:
    """Return titled images of a view: truth, then renders above errors, by falling PSNR; none if all are unreadable."""
    truth, renders = None, []
    for run in runs.to_dict("records"):
        try:
            truth, *drawn = split_image(run["renders"] / view, 3)
        except OSError as error:  # such as an incomplete file of a killed run
            warnings.append(f"a picture is left out: {error}")
            continue
        psnr, title = run["view_psnr"].get(view), methods.title(run["preset"])
        image = Image.fromarray(np.vstack([np.asarray(part.convert("RGB")) for part in drawn]))
        renders.append((math.inf, title, image) if psnr is None else (-psnr, f"{title}: {psnr:.2f} dB", image))
    renders.sort(key=lambda one: one[0])
    return [] if truth is None else [("ground truth", truth), *((title, render) for _, title, render in renders)]


def _sheet(name: str, title: str, images: list[tuple[str, Image.Image]], notes: tuple[str, ...]) -> Chart:
    """Return images with titles. Pillow draws them ten times faster than axes of matplotlib."""
    import matplotlib

    font = ImageFont.truetype(f"{matplotlib.get_data_path()}/fonts/ttf/DejaVuSans.ttf", FONT_SIZE)
    images = [(words, image.resize((WIDTH, round(WIDTH * image.height / image.width)), BOX)) for words, image in images]
    columns, row = min(COLUMNS, len(images)), TITLE + GAP + max(image.height for _, image in images)
    lines = wrap_title(title, columns * WIDTH // LETTER)
    head = TITLE * (lines.count("\n") + 2)
    sheet = Image.new("RGB", (columns * (WIDTH + GAP), head + row * math.ceil(len(images) / columns)), PAPER)
    draw = ImageDraw.Draw(sheet)
    draw.text((sheet.width / 2, TITLE / 2), lines, INK, font, anchor="ma", align="center")
    for number, (words, image) in enumerate(images):
        left, top = number % columns * (WIDTH + GAP) + GAP // 2, head + number // columns * row
        draw.text((left + WIDTH / 2, top), words, INK, font, anchor="ma")
        sheet.paste(image, (left, top + TITLE))
    return Chart(name, title, sheet, notes)
