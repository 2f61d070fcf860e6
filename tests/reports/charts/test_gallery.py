"""Sheets of a test view: the ground truth, and the render of each method."""

from dataclasses import replace

from support.made_up import compared, write

from padgs.reports import store
from padgs.reports.charts import gallery
from padgs.reports.frame import frame
from padgs.reports.selection import RunSet
from padgs.results import Scores


def sheets(folder):
    return gallery.charts(RunSet(frame(store.read(folder)[0])))


def test_each_scene_has_a_sheet_with_each_method_once_by_falling_psnr(tmp_path):
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
    outdoors, indoors = (chart.svg for chart in made)
    assert (indoors.count("<image"), outdoors.count("<image")) == (1 + 6, 1 + 5)  # one ran out of memory
    assert "OP43DGS" not in outdoors
    titles = ("ground truth", "PaD-GS: 26.00 dB", "SPaGS: 25.20 dB", "EgoNeRF: 22.00 dB")
    places = [indoors.index(title) for title in titles]
    assert places == sorted(places)


def test_runs_without_a_readable_render_are_left_out(tmp_path):
    first, second, *_ = compared(["synthetic-room"], seeds=1)
    write([first, second], tmp_path, renders=True)
    broken = tmp_path / first.run / "renders" / "view1.png"
    broken.write_bytes(broken.read_bytes()[:300])
    (sheet,) = sheets(tmp_path)
    assert sheet.svg.count("<image") == 2 and "EgoNeRF" not in sheet.svg
    for file in tmp_path.rglob("*.png"):
        file.write_bytes(b"cut")
    assert sheets(tmp_path) == sheets(write([first], tmp_path / "none")) == []
