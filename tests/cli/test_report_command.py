import csv
import shlex
import subprocess
import sys
from dataclasses import replace

import pytest
from support.made_up import compared, result, small, swept, write
from typer.testing import CliRunner

from padgs import results
from padgs.cli.commands import app
from padgs.reports import REPORTS


@pytest.fixture
def runs(tmp_path):
    for variant in ("baseline", "full"):
        (tmp_path / variant).mkdir()
        results.write(result(variant), tmp_path / variant)
    return tmp_path


def report(*arguments):
    return CliRunner().invoke(app, ["report", *map(str, arguments)])


def test_a_report_is_written_and_printed(runs, tmp_path):
    done = report("table3", runs, "--out", tmp_path / "out")
    assert done.exit_code == 0
    written = {path.name: path.read_text() for path in (tmp_path / "out").iterdir()}
    assert written.keys() == {"table3.md", "table3.tex", "table3.csv"}
    assert written["table3.md"] in done.output
    assert f"next: padgs report html {runs} --out {tmp_path / 'out'}" in done.output


def test_a_folder_without_results_is_refused_and_left_alone(runs, tmp_path):
    (empty := tmp_path / "empty").mkdir()
    for folder, way_out in ((empty, "give a folder of run folders"), (runs / "full", f"is one run: give {runs}")):
        before = sorted(folder.iterdir())
        done = report("all", folder)
        said = "".join((done.output + done.stderr).split())
        assert done.exit_code == 1 and "".join(way_out.split()) in said
        assert sorted(folder.iterdir()) == before


def test_runs_that_were_asked_to_stop_are_named(runs):
    (runs / "early").mkdir()
    early = replace(result("", run="early_1"), variant="stopped after 9 iterations", ended=results.STOP_REQUESTED)
    results.write(early, runs / "early")
    done = report("table3", runs)
    assert done.exit_code == 0 and "only in the table `runs`: early_1" in " ".join(done.stderr.split())


def test_the_same_results_give_the_same_bytes(runs, tmp_path):
    for name in ("one", "two"):
        report("table3", runs, "--out", tmp_path / name)
    assert (tmp_path / "one" / "table3.tex").read_bytes() == (tmp_path / "two" / "table3.tex").read_bytes()


def test_a_broken_file_is_named_and_left_out_and_strict_fails(runs):
    (runs / "full" / "result.json").write_text("{")
    done = report("table3", runs)
    assert done.exit_code == 0 and "left out" in done.output and "full/result.json" in done.output
    assert report("table3", runs, "--strict").exit_code == 1


def test_names_in_results_cannot_leave_the_folder(tmp_path):
    runs, out = tmp_path / "runs", tmp_path / "a" / "b" / "out"
    changes = {"scene": "../../x", "dataset": ""}, {"experiments": ("../../../x",)}, {"run": "../x"}
    for seed, change in enumerate(changes):
        (runs / str(seed)).mkdir(parents=True)
        results.write(result("", seed=seed, **change), runs / str(seed))
    done = report("all", runs, "--out", out)
    assert "'../../../x' is no name that this program gives" in done.output and "'../x' is no name" in done.output
    assert (out / "chart_..-..-x.png").is_file()
    assert {path for path in tmp_path.rglob("*") if path.is_file() and "runs" not in path.parts} == {*out.glob("*")}


def test_control_characters_in_names_are_escaped(tmp_path):
    (tmp_path / "run").mkdir()
    results.write(result("\x1b]0;title\x07<b>", scene="\x1b[2J", dataset="", run="x"), tmp_path / "run")
    done = report("runs", tmp_path)
    assert done.exit_code == 0 and "\x1b" not in done.output and "<b>" not in done.output


def test_parts_of_a_report_that_cannot_be_made_are_counted(runs):
    assert "reports without a table" not in report("all", runs).output
    done = report("all", runs, "--metric", "bogus")
    count = done.output.count("unknown metric 'bogus'")
    assert count > 1 and f"0 left out, and {count} reports without a table; see " in done.output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["table9"], f"unknown report 'table9'; known: {', '.join(sorted(REPORTS))}, all"),
        (["table3", "--where", "x"], "--where x is not KEY=VALUE"),
        (["runs", "--where", "seed=1", "--where", "seed=2"], "--where seed is 1 and 2; give one value of each key"),
        (["table3", "--protocol", "x"], "unknown protocol 'x'"),
        (["sweep", "--metric", "x"], "unknown metric 'x'; known under protocol paper: psnr, ssim"),
        (["sweep"], "nothing to show for sweep"),
        (["runs", "--protocol", "x"], "unknown protocol 'x'; known: paper, sphere"),
        (["html", "--experiment", "x"], "unknown experiment 'x'; known: ad_hoc"),
    ],
)
def test_invalid_arguments_are_refused(runs, arguments, message):
    done = report(arguments[0], runs, *arguments[1:])
    assert done.exit_code == 1 and message in done.output and "; see " not in done.output


def test_scenes_may_have_commas_in_their_names(tmp_path):
    first, *_, last = compared(["synthetic-room"], seeds=1)
    write([replace(first, dataset="", scene="Flat, old"), last], tmp_path)
    done = report("runs", tmp_path, "--scene", "Flat, old")
    assert done.exit_code == 0 and "Flat, old" in done.output and "synthetic-room" not in done.output


def test_each_name_of_a_list_must_fit(tmp_path):
    found = compared(["synthetic-room", "synthetic-outdoor"], seeds=1)
    write(found, tmp_path)
    for scenes in (["synthetic-room, synthetic_outdoor"], ["synthetic_room ,", "*-outdoor"], ["synthetic"]):
        done = report("runs", tmp_path, *(part for name in scenes for part in ("--scene", name)))
        assert done.exit_code == 0 and "synthetic-room" in done.output and "synthetic-outdoor" in done.output
    for wrong in (["synthetic-room,nosuch"], ["synthetic-room", "nosuch"], ["nosuch, synthetic-room"]):
        done = report("runs", tmp_path, *(part for name in wrong for part in ("--scene", name)))
        assert done.exit_code == 1 and "no run has scene nosuch; runs have" in done.output
    preset = found[0].preset
    done = report("runs", tmp_path, "--method", f"{preset}, padgz")
    assert done.exit_code == 1 and "no run has method padgz; runs have" in done.output


def test_a_missing_folder_is_refused(tmp_path):
    done = report("table3", tmp_path / "none")
    assert done.exit_code == 1 and "there is no folder" in done.output


def test_help_is_quick(root):
    code = "import sys, padgs.cli.commands; sys.exit('torch' in sys.modules or 'hydra' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=root).returncode == 0


def test_all_writes_every_report(tmp_path):
    runs = write([*compared(["synthetic-room"], seeds=1), *swept(scenes=["synthetic-room"])], tmp_path / "runs")
    done = report("all", runs, "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    written = {path.name for path in (tmp_path / "out").iterdir()}
    made = ("table1", "table4", "methods", "order", "runs")
    tables = {f"{name}.{extension}" for name in made for extension in ("md", "tex", "csv")}
    charts = {f"{name}.{e}" for name in ("chart_synthetic-room", "sweep_tau_cpu") for e in ("png", "csv")}
    assert written == tables | charts | {"time_synthetic-room.png", "report.html", "findings.md"}
    assert report("sweep", runs, "--out", tmp_path / "svg", "--svg").exit_code == 0
    assert (tmp_path / "svg" / "sweep_tau_cpu.svg").is_file()


def test_a_refused_report_does_not_stop_the_others(tmp_path):
    first, *others = compared(["synthetic-room"], seeds=1)
    write([replace(first, machine={"gpu": "H200"}), *others], tmp_path / "runs")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "table4.md").write_text("of other runs")
    done = report("all", tmp_path / "runs", "--out", tmp_path / "out", "--strict")
    assert done.exit_code == 1 and "error: table4: " in done.output and "differ in machine" in done.output
    assert (tmp_path / "out" / "table1.md").exists() and not (tmp_path / "out" / "table4.md").exists()


def test_no_old_table_lies_beside_new_ones(tmp_path):
    first, *others = compared(["synthetic-outdoor"], seeds=1)
    write([replace(first, machine={"gpu": "H200"}), *others], tmp_path / "runs")
    (tmp_path / "out").mkdir()
    mine = {f"{name}.{ending}" for name in ("gallery", "chart", "sweep") for ending in ("md", "tex", "csv")}
    old = {f"{name}.{ending}" for name in ("table1", "table4", "order") for ending in ("md", "tex", "csv")}
    for name in mine | old:
        (tmp_path / "out" / name).write_text("old")
    done = report("all", tmp_path / "runs", "--out", tmp_path / "out", "--strict")
    assert done.exit_code == 1 and "error: table4: " in done.output and "error: table1: " not in done.output
    written = {path.name: path.read_bytes() != b"old" for path in (tmp_path / "out").iterdir()}
    assert not {name for name in written if name.startswith(("table1.", "table4."))}, "empty, and refused"
    assert all(written[f"table2.{ending}"] for ending in ("md", "tex", "csv"))
    assert {name for name, is_new in written.items() if not is_new} == mine, "no report has tables of these names"


def test_a_file_in_the_place_of_the_folder_is_named_whatever_comes_first(tmp_path):
    write(compared(["synthetic-outdoor"], seeds=1), tmp_path / "runs")
    (tmp_path / "out").write_text("mine")
    done = report("all", tmp_path / "runs", "--out", tmp_path / "out")
    said = "".join((done.output + done.stderr).split())
    assert done.exit_code == 1 and "nameanotherplacewith--out" in said and (tmp_path / "out").read_text() == "mine"


def test_trials_of_different_kinds_have_their_own_blocks_and_rows(tmp_path):
    first, *others = compared(["synthetic-room"], seeds=1)
    longer = small(24.0, method="omnigs", iterations=7, experiments=("all_methods@cpu",))
    tau = replace(others[-1], run="tau", config={**others[-1].config, "method": {"tau": 0.5}})
    write([replace(first, machine={"gpu": "H200"}), *others, longer, tau], tmp_path / "runs")
    done = report("table4", tmp_path / "runs", "--out", tmp_path / "out")
    assert done.exit_code == 0 and "warning: table4: synthetic-room" in done.output
    for words in ("synthetic-room, 1500 iterations, H200", "synthetic-room, 7 iterations", "PaD-GS, tau 0.5"):
        assert words in done.output


def test_runs_without_an_experiment_are_a_sweep_where_they_differ_in_a_key(tmp_path):
    write([replace(one, experiments=()) for one in swept(scenes=["synthetic-room"], seeds=1)], tmp_path / "runs")
    assert report("sweep", tmp_path / "runs", "--metric", "psnr").exit_code == 0
    assert "tau" in (tmp_path / "runs" / "reports" / "sweep_ad_hoc.csv").read_text()


def test_the_sweep_of_the_quickstart_is_drawn(root, tmp_path):
    write(swept(), tmp_path / "runs")
    lines = (root / "docs" / "quickstart.md").read_text("utf-8").splitlines()
    (command,) = (shlex.split(line) for line in lines if line.startswith("padgs report sweep "))
    assert command[3] == "runs" and command[-4:] == ["--metric", "ws_psnr", "--metric", "gaussians"]
    done = report("sweep", tmp_path / "runs", *command[4:], "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"sweep_tau_cpu.png", "sweep_tau_cpu.csv"}
    points = list(csv.DictReader((tmp_path / "out" / "sweep_tau_cpu.csv").read_text("utf-8").splitlines()))
    room = {
        (float(of["x"]), of["quantity"]): (float(of["mean"]), of["n"])
        for of in points
        if of["scene"] == "synthetic-room"
    }
    assert {quantity for _, quantity in room} == {"WS-PSNR", "Gaussians"} and len(room) == 2 * 4
    assert room[0.9, "WS-PSNR"] == (pytest.approx(25 + 0.1 - 0.4), "3") and room[0.9, "Gaussians"] == (95_000, "3")


def test_an_experiment_is_known_without_its_scale_and_where_says_what_there_is(tmp_path):
    write(compared(["synthetic-room"], seeds=1), tmp_path / "runs")
    assert report("runs", tmp_path / "runs", "--experiment", "all_methods").exit_code == 0
    done = report("runs", tmp_path / "runs", "--where", "method.tau=0.5")
    assert done.exit_code == 1 and "no run has method.tau=0.5; runs have 0.9" in done.output


def test_edited_files_and_those_of_another_version_are_left_out_and_named(tmp_path):
    write([*compared(["synthetic-room"], seeds=1)], tmp_path)
    edited, old, cut, *_ = sorted(tmp_path.glob("*/result.json"))
    edited.write_text(edited.read_text().replace('"ssim"', '"sism"'))
    old.write_text(old.read_text().replace('"schema": ', '"schema": 90'))
    cut.write_bytes(cut.read_bytes()[:500])
    done = report("runs", tmp_path, "--out", tmp_path / "out", "--strict")
    assert done.exit_code == 1 and "3 results, 3 left out" in done.output
    for path, reason in ((edited, "was edited"), (old, "another version"), (cut, "is not JSON")):
        assert any(path.parent.name in line and reason in line for line in done.output.splitlines())
    page = report("html", tmp_path, "--out", tmp_path / "out")
    assert page.exit_code == 0 and "was edited" in (tmp_path / "out" / "report.html").read_text()


def test_where_leaves_out_methods_without_the_key(tmp_path):
    other = replace(result(""), run="b", method="omnigs", preset="omnigs", config={"method": {"degree": 3}, "seed": 0})
    write([replace(result(""), run="a"), other], tmp_path)
    done = report("runs", tmp_path, "--where", "method.tau=0.9")
    assert done.exit_code == 0 and "padgs" in done.output and "omnigs" not in done.output
