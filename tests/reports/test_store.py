import json
import shutil
from dataclasses import replace

import pytest
from support.made_up import compared, small, write
from typer.testing import CliRunner

from padgs import results
from padgs.cli.commands import app
from padgs.reports import store
from padgs.results import ResultError

LOCK = ".results.jsonl.lock"


def report(*arguments, code: int = 0):
    done = CliRunner().invoke(app, ["report", *map(str, arguments)])
    assert done.exit_code == code, done.output
    return done


@pytest.fixture
def runs(tmp_path):
    return write(compared(["synthetic-room"], seeds=1), tmp_path / "runs", renders=True)


def content(runs: list[store.Run]) -> list:
    return [(run.result, run.log) for run in runs]


def test_what_is_read_from_a_store_is_what_was_read_from_the_folder(runs, tmp_path):
    found, broken = store.read(runs)
    assert (
        broken == [] and len(found[0].log["psnr"]) == 15 and found[0].renders == runs / found[0].result.run / "renders"
    )
    store.add(found, tmp_path / "store.jsonl")
    again, broken = store.read(tmp_path / "store.jsonl")
    assert broken == [] and content(again) == content(found) and {run.renders for run in again} == {None}


def test_a_line_is_the_result_file_with_its_digest_and_the_log(runs, tmp_path):
    store.add(store.read(runs)[0], tmp_path / "store.jsonl")
    lines = [json.loads(line) for line in (tmp_path / "store.jsonl").read_text().splitlines()]
    assert [line["run"] for line in lines] == sorted(path.name for path in runs.iterdir())
    for line in lines:
        del line["log"]
        assert line == json.loads((runs / line["run"] / results.FILE_NAME).read_text())


def test_lines_of_a_log_that_are_no_probes_do_not_count(tmp_path):
    write([small(25.0)], tmp_path)
    (log,) = tmp_path.glob("*/log.jsonl")
    log.write_text(
        '{"iteration": 9, "seconds": 1.5, "psnr": 20.0}\n{"iteration": 10, "seconds": 1.6}\n'
        '{"iteration": 11, "seconds": 1.7, "psnr": NaN}\n{"iter'
    )
    assert store.read(tmp_path)[0][0].log == {"iteration": [9], "seconds": [1.5], "psnr": [20.0]}
    log.unlink()
    assert store.read(tmp_path)[0][0].log == {"iteration": [], "seconds": [], "psnr": []}


def test_runs_that_are_added_twice_change_nothing_and_later_ones_join(tmp_path):
    first, second = tmp_path / "first", tmp_path / "second"
    write([small(25.0), small(27.0)], first)
    write([small(26.0), small(27.0)], second)
    path = tmp_path / "store.jsonl"
    for _ in range(2):
        store.add(store.read(first)[0], path)
    once = path.read_bytes()
    assert len(once.splitlines()) == 2
    assert [run.result.scores["paper"].metrics["psnr"] for run in store.add(store.read(second)[0], path)] == [
        25,
        26,
        27,
    ]
    assert set(once.splitlines()) < set(path.read_bytes().splitlines())


def test_a_run_that_is_collected_from_two_folders_keeps_its_experiments(tmp_path):
    path = tmp_path / "store.jsonl"
    for name in ("capacity", "order"):
        folder = write([replace(small(25.0), experiments=(name,))], tmp_path / name)
        store.add(store.read(folder)[0], path)
    assert [run.result.experiments for run in store.read(path)[0]] == [("capacity", "order")]


def test_collected_runs_give_the_same_reports(runs, tmp_path):
    out = tmp_path / "measured"
    report("table1", runs, "--out", out, "--collect")
    assert {path.name for path in out.iterdir()} == {"table1.md", "table1.tex", "table1.csv", store.FILE_NAME, LOCK}
    report("table1", out / store.FILE_NAME, "--out", tmp_path / "again")
    report("chart", out / store.FILE_NAME)  # beside the store where no other place is named
    report("chart", runs, "--out", tmp_path / "again")
    for path in [*out.glob("table1*"), *(out / "reports").iterdir()]:
        assert path.read_bytes() == (tmp_path / "again" / path.name).read_bytes()


def test_reports_are_of_all_runs_that_were_ever_collected(tmp_path):
    for name, psnr in (("first", 25.0), ("second", 26.0)):
        done = report("runs", write([small(psnr)], tmp_path / name), "--out", tmp_path / "out", "--collect")
    assert "25.00" in done.output and "26.00" in done.output


def test_a_damaged_line_is_named_and_left_out_and_strict_fails(runs, tmp_path):
    path = tmp_path / "store.jsonl"
    store.add(store.read(runs)[0], path)
    edited, old, cut, bare, *others = path.read_text().splitlines()
    edited, old = edited.replace('"ssim"', '"sism"'), old.replace('"schema":', '"schema":90')
    bare = bare[: bare.rindex(',"log"')] + "}"
    path.write_text("\n".join([edited, old, cut[:500], bare, "", *others, ""]))
    done = report("runs", path, "--strict", code=1)
    assert "2 results, 4 left out" in done.output
    for number, reason in enumerate(("was edited", "another version", "is not JSON", "has no log"), start=1):
        assert any(f"store.jsonl:{number}" in line and reason in line for line in done.output.splitlines())
    assert report("runs", path)
    before = path.read_bytes()
    with pytest.raises(ResultError, match="store.jsonl:1 .* was edited"):
        store.add([], path)
    assert path.read_bytes() == before, "what was damaged may be mended; it is not thrown away"


def test_a_copy_of_a_run_is_left_out_by_name_and_the_table_is_made(runs, tmp_path):
    names = sorted(path.name for path in runs.iterdir())
    for copy in (f"a_backup_of_{names[0]}", f"{names[1]} (copy)"):
        shutil.copytree(runs / names["backup" not in copy], runs / copy)
    (runs / "last").symlink_to(names[-1])
    found, broken = store.read(runs)
    assert [run.result.run for run in found] == names and [run.renders.parent.name for run in found] == names
    assert len(broken) == 2 and all("is a copy of run" in str(error) for error in broken)
    report("table1", runs, "--out", tmp_path / "out")
