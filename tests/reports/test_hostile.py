"""Names and numbers from elsewhere: every output shows the names as text, and one bad result ends no report."""

import json
import math
import os
import re
import subprocess
import sys
import time
from dataclasses import replace

import pytest
from PIL import Image
from support.made_up import compared, external, result, run_set, scored, small, swept, write
from typer.testing import CliRunner

from padgs import results
from padgs.checks import printable
from padgs.cli.commands import app
from padgs.reports import REPORTS, store
from padgs.reports.charts.drawing import Chart
from padgs.reports.writers import files, latex_text, markdown_text
from padgs.results import Scores

EVIL = "a]\\[b](https://evil.example)!`c`|d*e_f<script>alert(1)</script>\n# g\t\x1b[2J\u202ehsur\u2028\x00&lt;{}$h$%~"
CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2066-\u2069]")


def report(*arguments, code: int = 0):
    done = CliRunner().invoke(app, ["report", *map(str, arguments)])
    assert done.exit_code == code, done.output
    assert "Traceback" not in done.output
    return done


@pytest.fixture(scope="module")
def texts() -> dict[str, str]:
    """The text of each file of all reports on runs with hostile names."""
    made = [replace(run, scene=EVIL, dataset="") for run in compared(["synthetic-room"], seeds=3)]
    made += [
        small(
            25.0 + tau, scene=EVIL, dataset="", experiments=("tau",), config={"method": {"tau": tau, EVIL: EVIL[::-1]}}
        )
        for tau in (0.5, 0.9)
    ]
    rules = {"name": EVIL, "lpips": EVIL, "lpips_inputs": EVIL}
    odd = small(20.0, method="mine", scene=EVIL, dataset="", experiments=("all_methods",), machine={"cpu": EVIL})
    made.append(
        replace(odd, variant=EVIL, code_version=EVIL, scores={"paper": Scores(rules, {"psnr": 1.0, EVIL: 2.0}, {})})
    )
    found = run_set(made, mix=True)
    shown = (pair for name in REPORTS for pair in files(found.report(name), svg=True))
    return {name: content.decode() for name, content in shown if not name.endswith(".png")}


def test_control_characters_reach_no_output(texts):
    assert {name.rpartition(".")[2] for name in texts} == {"md", "tex", "csv", "svg", "html"}
    for name, text in texts.items():
        ours = re.sub(r"<(script|style)\b.*?</\1>", "", text, flags=re.S)  # vendored code has its own
        assert not CONTROL.search(ours), name
        assert r"\u202e" in text.replace("textbackslash{}", "").replace("\\\\", "\\") or "hsur" not in text, name


def test_names_are_text_and_no_markup(texts):
    for name, text in texts.items():
        if name.endswith(".md") and "hsur" in text:
            assert not re.search(r"(?<!\\)\]\(https", text) and not re.search(r"(?<!\\)`c", text), name
            assert "<script>" not in text and "\n# g" not in text
            for line in text.splitlines():
                columns = len(re.findall(r"(?<!\\)(?:\\\\)*\|", line))
                assert columns == 0 or line.startswith("|"), "a bar of a name starts no cell"
        if name.endswith((".html", ".svg")):
            assert "<script>alert" not in text, name
        if name.endswith(".tex") and "hsur" in text:
            assert r"\textbackslash{}[b](https" in text and "\n\n" not in text, name


@pytest.mark.parametrize("character", "\\`*_[]|~$#<")
def test_markdown_and_latex_escape_each_special_character(character):
    assert markdown_text(f"a{character}b") in (rf"a\{character}b", "a&lt;b")
    special = "\\~^&%$#_{}<>|"
    assert all(latex_text(c) != c for c in special)


def test_markdown_makes_no_links_or_entities():
    assert markdown_text("https://x.org www.x.org &lt; A & B") == r"https\://x.org www\.x.org &amp;lt; A & B"


@pytest.mark.parametrize("character", ["\x1b", "\x9b", "\u202e", "\u2066", "\u200f", "\u2028", "\ud800", "\x00", "\r"])
def test_the_terminal_gets_no_control_characters(character):
    assert printable(f"a{character}b").isprintable() and printable("Küche 東京\n") == "Küche 東京\n"


def changed(run, **changes):
    return replace(run, run="hostile", **changes)


STEP = {"rows": 1, "blended": 1, "bytes": 1, "frame_ms": 1.0, "loss": 0.0, "ws_psnr": 1.0, "lpips": None}
SEARCH = {"rows": 1, "steps": [STEP], "minimal": {}, "cpu_seconds": 1}
HOSTILE = {
    "a long scene": {"scene": "x" * 10_000},
    "a long variant": {"variant": "x" * 300},
    "negative seconds": {"timing": {"train_seconds": -1.0}},
    "endless seconds": {"timing": {"train_seconds": math.inf}},
    "iteration -5": {"iterations_done": -5},
    "a huge number": {"config": {"method": {"tau": 10**30}}},
    "a lone surrogate": {"config": {"method": {"\ud800": 1}}},
    "a rate that is none": {"config": {"train": {"learning_rates": ["run"]}}},
    "a negative budget": {"config": {"budget": {"seconds": -5, "clock": "cpu"}}},
    "a budget without a clock": {"config": {"budget": {"seconds": 5}}},
    "a level that is none": {"config": {"stress": {"condition": ["noise"], "level": "severe"}}},
    "rules that are none": {"scores": {"paper": Scores({"bottom_crop": "all"}, {"psnr": 1.0}, {})}},
    "a long view": {"scores": {"paper": Scores({}, {"psnr": 1.0}, {"v" * 9999: {"psnr": 1.0}})}},
    "a search without steps": {"smallest": {"steps": []}},
    "a search that found nothing": {"smallest": SEARCH},
    "rays of no width": {"method": "egonerf", "width": 0, "config": {"method": {"rays": 3}}},
}


@pytest.mark.parametrize("what", HOSTILE)
def test_a_run_that_cannot_be_is_left_out_by_name(what, tmp_path):
    good, other = compared(["synthetic-room"], seeds=1)[4:6]
    write([good, changed(other, **HOSTILE[what])], tmp_path)
    found, broken = store.read(tmp_path)
    assert [run.result.run for run in found] == [good.run] and len(broken) == 1
    assert "hostile" in str(broken[0]) and len(str(broken[0])) < 600


EXACT = {"scores": scored(math.inf)}  # as of somebody who scores the photographs themselves


@pytest.mark.parametrize(
    ("name", "made"),
    [
        ("chart", [external(25.0, "A & B"), external(26.0, "C")]),
        ("sweep", [replace(run, **EXACT) if run.seed else run for run in swept(scenes=["synthetic-room"], seeds=2)]),
        ("findings", [replace(run, **EXACT) if run.method == "padgs" else run for run in compared(seeds=2)]),
    ],
)
def test_exact_renders_and_other_programs_alone_end_no_report(name, made):
    assert dict(files(run_set(made).report(name)))


def test_names_in_other_scripts_give_files_of_their_own_with_names_that_file_systems_accept():
    charts = [Chart(name, "", Image.new("RGB", (1, 1))) for name in ("客厅", "卧室", "客" * 90, "客" * 91)]
    names = [name for name, _ in files(charts)]
    assert names[:2] == ["客厅.png", "卧室.png"] and len({*names}) == 4
    assert max(len(name.encode()) for name in names) < 240


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999", "9" * 5000])
def test_numbers_that_json_does_not_have_leave_their_run_out(number, tmp_path):
    good, other = compared(["synthetic-room"], seeds=1)[4:6]
    write([good, other], tmp_path)
    path = tmp_path / other.run / results.FILE_NAME
    path.write_text(path.read_text().replace(str(other.scores["paper"].metrics["psnr"]), number))
    done = report("all", tmp_path)
    assert "1 results, 1 left out" in done.output and f"left out: {path}" in done.output
    assert "SPaGS" in (tmp_path / "reports" / "table1.md").read_text()


@pytest.mark.parametrize(
    "log",
    [{"psnr": [math.inf]}, {"seconds": [-1.0]}, {"iteration": [-5]}, {"psnr": ["a"]}, {"psnr": []}, {"psnr": None}],
)
def test_a_log_that_no_run_writes_leaves_its_line_out(log, tmp_path):
    lines = [run for run in store.read(write(compared(["synthetic-room"], seeds=1), tmp_path / "runs"))[0]]
    merged = store.add(lines, tmp_path / "results.jsonl")
    texts = (tmp_path / "results.jsonl").read_text().splitlines()
    first = json.loads(texts[0])
    first["log"] = {"iteration": [5], "seconds": [1.0], "psnr": [20.0]} | log
    (tmp_path / "results.jsonl").write_text("\n".join([json.dumps(first).replace("Infinity", "1e999"), *texts[1:]]))
    found, broken = store.read(tmp_path / "results.jsonl")
    assert len(found) == len(merged) - 1 and first["run"] in str(broken[0])


def test_impossible_lines_of_a_log_do_not_count(tmp_path):
    write([small(25.0)], tmp_path)
    (log,) = tmp_path.glob("*/log.jsonl")
    probe = {"iteration": 9, "seconds": 1.5, "psnr": 20.0}
    odd = [{"iteration": -5}, {"seconds": -1}, {"psnr": 10**400}, {"iteration": 1e999}]
    log.write_text(
        "\n".join(json.dumps(probe | of).replace("Infinity", "1e999") for of in ({}, *odd)) + "\n" + "[" * 10**5
    )
    assert store.read(tmp_path)[0][0].log == {"iteration": [9], "seconds": [1.5], "psnr": [20.0]}


def test_a_pipe_in_place_of_a_result_does_not_hang(tmp_path):
    write([small(25.0)], tmp_path)
    for name in ("result.json", "log.jsonl"):
        (tmp_path / name[:3]).mkdir()
        os.mkfifo(tmp_path / name[:3] / name)
    found, broken = store.read(tmp_path)
    assert len(found) == 1 and "res/result.json: it is no regular file" in str(broken[0])


def test_a_picture_that_cannot_be_read_is_left_out_by_name(tmp_path):
    first, second = compared(["synthetic-room"], seeds=1)[4:6]
    write([first, second], tmp_path, renders=True)
    bomb, narrow = (tmp_path / first.run / "renders" / f"view{n}.png" for n in (0, 1))
    Image.new("1", (30_000, 15_000)).save(bomb)
    Image.new("RGB", (2, 1)).save(narrow)
    for what in ("html", "gallery"):
        done = report(what, tmp_path)
        assert f"a picture is left out: {narrow}" in done.output
    assert f"a picture is left out: {bomb} is too large" in report("html", tmp_path).output


def test_long_names_of_scenes_give_files(tmp_path):
    made = [result("", dataset="", scene="x" * 250, run=f"r{n}", seed=n) for n in range(2)]
    report("all", write(made, tmp_path / "runs"), "--svg", "--out", tmp_path / "out")
    assert max(len(path.name) for path in (tmp_path / "out").iterdir()) < 240


def test_reports_at_the_same_time_lose_no_run(tmp_path):
    """Each collects runs of its own into one store."""
    out, made = tmp_path / "out", [small(20 + n / 10, seed=n) for n in range(15)]
    folders = [write(made[n : n + 5], tmp_path / f"runs{n}") for n in range(0, 15, 5)]
    code = "import sys, time; from pathlib import Path; from padgs.reports import store\n"
    code += "runs, out, go = store.read(Path(sys.argv[1]))[0], Path(sys.argv[2]), Path(sys.argv[3])\n"
    code += "while not go.exists(): time.sleep(0.01)\n"
    code += "[store.add([run], out / store.FILE_NAME) for run in runs]"
    out.mkdir()
    go = tmp_path / "go"
    started = [subprocess.Popen([sys.executable, "-c", code, folder, out, go]) for folder in folders]
    time.sleep(2)
    go.touch()
    assert [process.wait() for process in started] == [0] * len(started)
    assert len(store.read(out / store.FILE_NAME)[0]) == len(made)
