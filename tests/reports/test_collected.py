from made_up import compared, write
from typer.testing import CliRunner

from padgs import results
from padgs.cli.app import app
from reports.quality_log import probes


def report(*arguments):
    done = CliRunner().invoke(app, ["report", *map(str, arguments)])
    assert done.exit_code == 0, done.output
    return done


def test_collected_results_give_the_same_reports_and_are_small(tmp_path):
    runs = write(compared(["synthetic-room"], seeds=1), tmp_path / "runs", pictures=True)
    report("table1", runs, "--out", tmp_path / "measured", "--collect")
    collected = tmp_path / "measured" / "results"
    assert results.read_all(collected)[0] == results.read_all(runs)[0]
    assert {path.name for path in collected.glob("*/*")} == {"result.json", "log.jsonl"}
    assert probes(collected, results.read_all(collected)[0]) == probes(runs, results.read_all(runs)[0])
    report("table1", collected, "--out", tmp_path / "again")
    for extension in ("md", "tex", "csv"):
        first, second = (tmp_path / name / f"table1.{extension}" for name in ("measured", "again"))
        assert first.read_bytes() == second.read_bytes()
