"""Sheets of a test view: the ground truth, and the render of each method."""

import io
from dataclasses import replace

import pytest
from PIL import Image
from support.made_up import compared, write

from padgs.reports import store
from padgs.reports.charts import gallery
from padgs.reports.frame import frame
from padgs.reports.selection import RunSet
from padgs.reports.table import ReportError
from padgs.results import Scores


@pytest.fixture
def written(monkeypatch) -> dict[str, list[str]]:
    """Title of a sheet -> titles of its images, filled while sheets are made."""
    found, draw = {}, gallery._sheet

    def drawn(name, title, images, notes):
        found[title.split("\n")[0]] = [words for words, _ in images]
        return draw(name, title, images, notes)

    monkeypatch.setattr(gallery, "_sheet", drawn)
    return found


def sheets(folder):
    return gallery.charts(RunSet(frame(store.read(folder)[0])))


def test_each_scene_has_a_sheet_with_each_method_once_by_falling_psnr(tmp_path, written):
    runs = []
    for one in compared(seeds=2):
        scores = {
            name: Scores(of.protocol, of.metrics, {"view0": of.metrics, "view1": of.metrics})
            for name, of in one.scores.items()
        }
        runs.append(replace(one, scores=scores))
    made = sheets(write(runs, tmp_path, renders=True))
    names = [f"gallery_synthetic-{scene}_512x256_1500-iterations" for scene in ("outdoor", "room")]
    assert [chart.name for chart in made] == names
    outdoors, indoors = (written[chart.title.split("\n")[0]] for chart in made)
    assert len(outdoors) == 5 + 1 and not any("OP43DGS" in title for title in outdoors), "one ran out of memory"
    titles = ("ground truth", "PaD-GS: 26.00 dB", "SPaGS: 25.20 dB", "EgoNeRF: 22.00 dB")
    places = [indoors.index(title) for title in titles]
    assert places == sorted(places) and len(indoors) == 6 + 1
    assert Image.open(io.BytesIO(made[0].png)).width == 3 * 432


def test_runs_without_a_readable_render_are_left_out(tmp_path, written):
    first, second, *_ = compared(["synthetic-room"], seeds=1)
    write([first, second], tmp_path, renders=True)
    broken = tmp_path / first.run / "renders" / "view1.png"
    broken.write_bytes(broken.read_bytes()[:300])
    (sheet,) = sheets(tmp_path)
    (titles,) = written.values()
    assert sheet.name.startswith("gallery") and titles == ["ground truth", "OP43DGS, corrected: 22.80 dB"]
    for file in tmp_path.rglob("*.png"):
        file.write_bytes(b"cut")
    assert sheets(tmp_path) == sheets(write([first], tmp_path / "none")) == []


def test_two_settings_of_a_method_do_not_stand_for_each_other(tmp_path):
    first, *_ = compared(["synthetic-room"], seeds=1)
    other = replace(first, run="other", config={**first.config, "method": {"tau": 0.0}})
    with pytest.raises(ReportError, match="differ in method.tau"):
        sheets(write([first, other], tmp_path, renders=True))
