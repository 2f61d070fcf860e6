import csv
import json
import math
import re
import time
from dataclasses import replace

import pytest
from PIL import Image
from support.chromium import in_chromium, visiting
from support.made_up import at_equal_time, compared, data_set, failed, run_set, small, swept, write

from padgs.reports import store
from padgs.reports.frame import frame
from padgs.reports.page import page
from padgs.reports.selection import Request, RunSet


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("page") / "runs"
    results = [*compared(["synthetic-room"], seeds=1), *swept(scenes=["synthetic-room"], seeds=2)]
    return frame(store.read(write(results, folder, renders=True))[0])


@pytest.fixture(scope="module")
def html(runs) -> str:
    return page.html(RunSet(runs, Request(), ("runs/x/result.json was edited",)))


def test_it_needs_nothing_from_outside(html):
    loading = r"""(?:src|href|xlink:href)=["'](?!#|data:)([^"']*)|url\((?!['"]?(?:#|data:))([^)]*)\)|@import"""
    body = re.sub(r"<script>.*?</script>", "", html, flags=re.DOTALL)
    assert [found for found in re.findall(loading, body) if any(found)] == []
    assert "connect-src blob: data:" in html and "MIT" in html and "Matthew Petroff" in html


def test_it_has_the_tables_the_charts_and_what_was_left_out(html):
    for words in ("Table 4", "Sweep tau@cpu", "synthetic-room (generated", "runs/x/result.json was edited"):
        assert words in html
    assert "26.02" not in html, "numbers of the paper where nothing of ours stands beside them"
    assert html.count('<figure class="chart"') == 3


def test_the_mean_after_equal_time_is_the_first_chart():
    html = page.html(run_set(at_equal_time("synthetic-room", "synthetic-outdoor")))
    assert "mean over synthetic-outdoor, synthetic-room" in html.partition('<figure class="chart"')[2][:2000]
    charts, first, second = (html.index(f'<section id="{name}"') for name in ("charts", "equal_time", "runs"))
    assert charts < first < second and 'download="equal_time.csv"' in html and '<select id="set"' in html


def test_the_page_is_about_the_runs_that_were_asked_for():
    made = page.html(run_set(compared(["synthetic-room", "synthetic-outdoor"], 1), scenes=("synthetic-room",)))
    assert "synthetic-outdoor" not in made and f"{len(compared(['synthetic-room'], 1))} runs" in made


def test_scenes_can_be_chosen_by_set_and_by_name():
    own = [
        replace(one, dataset="", scene="plaza", fingerprint="da838962d5", run=f"own{one.run}")
        for one in compared(["synthetic-room"], 1)
    ]
    runs = run_set([*compared(["synthetic-room", "synthetic-outdoor"], 1), *own]).runs
    sets = page._scene_sets(runs)
    assert sets["not tuned on"] == ["plaza"] and sets["synthetic-room"] == ["synthetic-room"]
    assert sorted(sets["synthetic"]) == ["synthetic-outdoor", "synthetic-room"]


@pytest.fixture(scope="module")
def of_paper() -> str:
    """A page of runs on all scenes of 360Roam, and on a built-in one."""
    return page.html(run_set([*data_set("roam360"), *compared(["synthetic-room"], 1)]))


def about(html: str, section: str) -> list[str]:
    """Return the subjects (`data-of`) of the parts of a section."""
    return re.findall(r'data-of="([^"]*)"', html.partition(f'<section id="{section}"')[2].partition("</section>")[0])


def data_of(html: str):
    return json.loads(html.partition('id="data">')[2].partition("</script>")[0])


def test_a_data_set_of_the_paper_has_all_parts_with_its_title(of_paper):
    sets = data_of(of_paper)["sets"]
    title, *scenes = sets["360Roam"]
    assert title == "360Roam" and {"bar", "base", "cafe"} <= {*scenes} and len(scenes) == 11
    assert sets["360Roam, bar"] == ["bar"] and sets["synthetic"] == ["synthetic-room"], "no part has that title"
    for section in ("table1", "table4"):
        every = about(of_paper, section)
        assert every[0] == "360Roam, average over its 11 scenes" and every[-1].startswith("synthetic-room")
        assert all("360Roam" in of for of in every[:-1])


def test_a_block_with_scenes_down_is_about_each_of_its_scenes(of_paper):
    _, *scenes = data_of(of_paper)["sets"]["360Roam"]
    down = dict(of.split(", 360Roam ") for of in about(of_paper, "table1") if ", 360Roam " in of)
    assert [*down] == ["SSIM ↑", "PSNR ↑", "LPIPS VGG [0, 1] ↓"]
    for rows in down.values():
        assert {*scenes} <= {*rows.replace(",", "").split()} and rows.startswith("bar bar, paper ")


def test_a_figure_is_about_the_scenes_that_its_notes_name(html):
    assert about(html, "sweeps")[0].startswith("Sweep tau@cpu: mean and standard deviation over seeds;")
    for section in ("charts", "sweeps"):
        assert all("synthetic-room (generated, tuned on): protocol " in of for of in about(html, section))


def pinhole_and_panorama(folder):
    """A run with two test views: view0 is a panorama, view1 has 4:3 pixels."""
    write([small(25.0, run="one")], folder, renders=True)
    Image.new("RGB", (3 * 64, 48), "gray").save(folder / "one" / "renders" / "view1.png")
    return page.html(RunSet(frame(store.read(folder)[0])))


def test_views_of_pinhole_cameras_are_no_panoramas(tmp_path):
    (scene,) = data_of(pinhole_and_panorama(tmp_path))["scenes"]
    assert {view["title"]: view["panorama"] for view in scene["views"]} == {"view0": True, "view1": False}
    assert all(len(view["methods"]) == 1 for view in scene["views"]), "each is shown beside its render"


def test_names_are_text_and_not_markup():
    evil = "</script><b-x>$a_b"
    texts = {"scene": evil, "code_version": evil, "finished": evil, "machine": {"gpu": evil}}
    html = page.html(run_set([small(25.0, method="<i-x>", **texts), replace(failed(evil, "oom"), reason=evil)]))
    assert "<b-x>" not in html and "<i-x>" not in html and html.count("&lt;b-x&gt;$a_b") > 10


def test_runs_without_renders_give_a_page_without_views():
    html = page.html(run_set([failed("", "oom")]))
    assert 'id="slider"' not in html and "OOM" in html


def test_a_refused_table_is_named_and_the_others_are_there():
    first, *others = data_set("roam360")
    html = page.html(run_set([replace(first, machine={"gpu": "H200"}), *others], strict=True))
    assert "differ in machine" in html and 'id="table1"' in html and 'id="table4"' not in html


def test_the_users_captures_and_the_best_method_come_first(tmp_path):
    own = [replace(one, dataset="", scene="z-flat", run=f"own{one.run}") for one in compared(["synthetic-room"], 1)]
    write([*compared(["synthetic-room"], 1), *own], tmp_path, renders=True)
    first, second = page.album(RunSet(frame(store.read(tmp_path)[0]))).scenes
    assert first["title"].startswith("z-flat") and second["title"].startswith("synthetic-room")
    psnr = [float(method["title"].split()[-2]) for method in first["views"][0]["methods"]]
    assert psnr == sorted(psnr, reverse=True) and len(psnr) == 6


def test_pictures_are_of_runs_that_did_not_fail(tmp_path):
    first = small(20.0, seed=0, status="degenerate")
    write([first, small(21.0, seed=1)], tmp_path, renders=True)
    (scene,) = page.album(RunSet(frame(store.read(tmp_path)[0]))).scenes
    assert [method["title"] for method in scene["views"][0]["methods"]] == ["PaD-GS, PSNR 21.00 dB"]


def test_an_exact_render_is_sorted_as_the_best_and_columns_are_named_with_their_group():
    html = page.html(run_set([small(math.inf), *data_set("roam360")]))
    assert 'data-sort="999999999.000000000"' in html and 'data-sort="inf"' not in html
    assert 'data-group="PSNR">paper ↑<' in html


def test_the_number_of_files_is_bounded(runs, monkeypatch):
    made = page.album(RunSet(runs))
    (scene,) = made.scenes
    assert [view["title"] for view in scene["views"]] == ["view0", "view1"]
    assert [method["title"] for method in scene["views"][0]["methods"]][0] == "PaD-GS, PSNR 26.00 dB"
    assert len(made.images) == 2 * (1 + 2 * 6) and max(map(len, made.images)) < 10_000
    monkeypatch.setattr(page, "MAX_FILES", 6)
    assert [len(scene["views"]) for scene in page.album(RunSet(runs)).scenes] == [1]
    monkeypatch.setattr(page, "MAX_FILES", 5)
    assert page.album(RunSet(runs)).left_out == ["synthetic-room (generated, tuned on)"]


@pytest.mark.slow
@in_chromium
def test_in_a_browser(html, tmp_path):
    (tmp_path / "report.html").write_text(html)
    with visiting((tmp_path / "report.html").as_uri()) as visit:
        page = visit.page
        visit.wait("viewers.length === 2 && viewers.every(viewer => viewer.isLoaded())")

        first_cells = "[...document.querySelectorAll('#table1 tbody')].at(-1).querySelectorAll('td:first-child')"
        rows = f"[...{first_cells}].map(cell => cell.textContent)"
        assert page.evaluate(rows)[0] == "EgoNeRF"
        orders = []
        for _ in range(2):
            page.locator("#table1 table").last.locator("thead tr:last-child th:nth-child(3)").click()
            orders.append(page.evaluate(rows))
        assert {order[0] for order in orders} == {"EgoNeRF", "PaD-GS"} and orders[0] == orders[1][::-1]

        page.set_viewport_size({"width": 390, "height": 844})
        assert page.evaluate("document.documentElement.scrollWidth") == 390
        stays = "getComputedStyle(document.querySelector('#table1 tbody td')).position"
        assert page.evaluate(stays) == "static", "names would cover the numbers"
        page.set_viewport_size({"width": 1400, "height": 1000})
        assert page.evaluate(stays) == "sticky"

        before = page.evaluate("document.getElementById('slider').value")
        visit.drag("#slider", 200, 0)
        assert page.evaluate("document.getElementById('slider').value") > before + 5

        yaws = "viewers.map(viewer => viewer.getYaw())"
        assert page.evaluate(yaws) == [0, 0]
        visit.drag("#panorama-render", -150, 0)
        visit.wait(f"{yaws}.every(yaw => yaw > 5)")
        time.sleep(1.5)  # inertia
        truth, render = page.evaluate(yaws)
        assert truth == pytest.approx(render, abs=0.5)

        page.select_option("#method", index=5)
        visit.wait("viewers.every(viewer => viewer.isLoaded())")
        assert page.locator("#slider [slot=second] figcaption").text_content() == "EgoNeRF, PSNR 22.00 dB"

        shown = "[...document.querySelectorAll('#table1 [data-of]')].map(part => part.hidden)"
        page.select_option("#set", label="synthetic-room")
        assert page.evaluate(shown) == [False]
        with page.expect_download() as saved:
            page.locator("#table1 a[download]").click()
        numbers = list(csv.DictReader(saved.value.path().read_text("utf-8").splitlines()))
        psnr = {line["row"]: line["value"] for line in numbers if line["column"].startswith("PSNR")}
        assert float(psnr["PaD-GS"]) == pytest.approx(26.0) and float(psnr["EgoNeRF"]) == pytest.approx(22.0)
        page.evaluate("document.querySelector('#table1 [data-of]').dataset.of = 'a-synthetic-room (generated)'")
        page.select_option("#set", label="synthetic")
        assert page.evaluate(shown) == [True] and not page.locator("#table1").is_visible()
        page.select_option("#set", label="all scenes")
        assert page.evaluate(shown) == [False] and page.locator("#table1").is_visible()

        assert visit.complaints == []
        assert {url.partition(":")[0] for url in visit.requests} <= {"file", "blob", "data"}


@pytest.mark.slow
@in_chromium
def test_in_a_browser_a_pinhole_view_has_no_viewer(tmp_path):
    (tmp_path / "report.html").write_text(pinhole_and_panorama(tmp_path / "runs"))
    with visiting((tmp_path / "report.html").as_uri()) as visit:
        for view, caption in (("view0", "25.00"), ("view1", "25.00"), ("view0", "25.00")):
            visit.page.select_option("#view", label=view)
            assert visit.page.locator("#viewer").is_visible() == (view == "view0")
            assert caption in visit.page.locator("#slider [slot=second] figcaption").text_content()
        visit.wait("viewers.length === 2 && viewers.every(viewer => viewer.isLoaded())")
        assert visit.complaints == []


@pytest.mark.slow
@in_chromium
def test_in_a_browser_a_data_set_of_the_paper_keeps_its_tables(of_paper, tmp_path):
    (tmp_path / "report.html").write_text(of_paper)
    shown = "[...document.querySelectorAll('#table1 [data-of]:not([hidden]) caption')].map(of => of.textContent)"
    down = [f"{metric}, 360Roam" for metric in ("SSIM ↑", "PSNR ↑", "LPIPS VGG [0, 1] ↓")]
    with visiting((tmp_path / "report.html").as_uri()) as visit:
        mean, *parts, room = visit.page.evaluate(shown)
        assert mean.startswith("360Roam, average") and parts == down and room.startswith("synthetic-room")
        for label, expected in (("360Roam", [mean, *down]), ("360Roam, bar", down), ("synthetic", [room])):
            visit.page.select_option("#set", label=label)
            assert visit.page.evaluate(shown) == expected, label
        assert visit.complaints == []
