"""`padgs equal-time`, and command lines made from configurations."""

import json
import shlex
from dataclasses import replace
from pathlib import Path

import pytest
from composed import composed, first_and_last_job
from typer.testing import CliRunner

from padgs import results
from padgs.cli.app import app
from padgs.cli.equal_time import iterations, lengths
from padgs.multirun.composition import composing, settings_of
from padgs.results import Result

LINES = (
    ("method=omnigs", "seed=3", "data.path=/a b/c", "render.bounds=square", "render.wrap=false"),
    ("method=padgs", "method.tau=0.8", "method.offset_rate=[0.1,0.2]", "train.max_seconds=10", "data.mask=none"),
    ("method=egonerf_small", "train.iterations=70", "run.threads=1", "data.generator.scene=outdoor"),
    ("method=sc_omnigs", "method.poses.rotation=0.5", "method.max_gaussians=null", "protocol.paper.bottom_crop=0.063"),
)


@pytest.mark.parametrize("line", LINES, ids=lambda line: line[0])
def test_the_settings_of_a_configuration_compose_it_again(line):
    wanted = json.loads(json.dumps(composed(*line).values()))  # as a result file holds it
    with composing():
        settings = settings_of(wanted, line[0])
    assert len(settings) == len(line), "no more than what differs"
    assert json.loads(json.dumps(composed(*settings).values())) == wanted


def test_an_experiment_can_be_told_by_settings_alone():
    for config in first_and_last_job("+experiment=ablation", "scale=cpu"):
        wanted = json.loads(json.dumps(config.values()))
        with composing():
            settings = settings_of(wanted, f"method={config.preset}")
        assert json.loads(json.dumps(composed(*settings).values())) == wanted


def run(seconds: float, *line: str, experiments: tuple[str, ...] = (), status: str = "ok") -> Result:
    """A result as a run of `line` would have left it."""
    config = composed(*line)
    values = json.loads(json.dumps(config.values()))
    return Result(
        run=f"{config.preset}_{config.train.iterations}",
        status=status,
        method=config.method,
        preset=config.preset,
        variant=config.variant,
        dataset="synthetic",
        scene="room",
        width=128,
        height=64,
        iterations=config.train.iterations,
        iterations_done=config.train.iterations,
        seed=config.seed,
        code_version="",
        machine={},
        config_hash="",
        fingerprint="f",
        finished="",
        timing={"train_seconds": seconds},
        config=values,
        experiments=experiments,
    )


def write(runs: list[Result], folder: Path) -> Path:
    for one in runs:
        (folder / one.run).mkdir()
        results.write(one, folder / one.run)
    return folder


def printed(folder: Path, *arguments: str) -> list[list[str]]:
    done = CliRunner().invoke(app, ["equal-time", str(folder), *arguments])
    assert done.exit_code == 0, done.output
    return [shlex.split(line) for line in done.stdout.splitlines()]


def test_prints_what_takes_as_long_as_asked_for(tmp_path: Path):
    slow = run(200.0, "method=spags", "train.iterations=500", "run.threads=1")
    fast = run(20.0, "method=omnigs", "train.iterations=500", "data.width=64")
    lines = printed(write([slow, fast], tmp_path), "50", "tracking=none")
    for line, result, expected in zip(sorted(lines), (fast, slow), (1250, 125), strict=True):
        assert line[0] == "padgs-run" and "tracking=none" in line
        config = composed(*line[1:])
        assert config.train.iterations == expected and config.labels.experiments == ("equal_time",)
        assert config.preset == result.preset and config.run.folder == str(tmp_path)
        unchanged = replace(config, train=replace(config.train, iterations=500)).values()
        assert json.loads(json.dumps(unchanged | {"run": result.config["run"]})) == result.config


def test_nothing_is_printed_once_all_are_there(tmp_path: Path):
    first = run(200.0, "method=spags", "train.iterations=500")
    second = run(52.0, "method=spags", "train.iterations=125", experiments=("equal_time",))
    assert printed(write([first, second], tmp_path), "50") == printed(tmp_path, "190") == []
    assert composed(*printed(tmp_path, "100")[0][1:]).train.iterations == 245


def test_times_of_other_machines_are_refused(tmp_path: Path):
    here = run(200.0, "method=spags", "train.iterations=500")
    there = replace(run(20.0, "method=omnigs", "train.iterations=500"), machine={"gpu": "H200", "torch": "2.11"})
    done = CliRunner().invoke(app, ["equal-time", str(write([here, there], tmp_path)), "60"])
    assert done.exit_code == 1 and "are of several machines" in done.stderr and "H200, torch 2.11" in done.stderr


def test_lengths_come_from_the_nearest_runs_of_the_same_settings():
    runs = [run(s, "method=omnigs", f"train.iterations={n}") for s, n in ((10, 100), (60, 400), (375, 900))]
    other = run(50.0, "method=omnigs", "train.iterations=7", "method.sh_degree=0")
    assert lengths([*runs, other]) == [runs, [other]]
    assert iterations(runs, 62) == 400, "the run itself"
    assert iterations(runs, 150) == 600, "the geometric mean of 60 s and 375 s takes that of 400 and 900 iterations"
    assert iterations(runs[:2], 150) == 1000 and iterations(runs[1:], 20) == 133, "beyond them in proportion"
    assert iterations(runs, 0.01) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere", "60"], "there is no folder nowhere"),
        (["{runs}", "0"], "seconds is 0; it must be > 0"),
        (["{runs}", "inf"], "seconds is inf; it must be > 0 and finite"),
        (["{runs}", "60"], "has ended well; run the methods first"),
        (["{runs}", "60", "--experiment", "x"], "unknown experiment 'x'; known: none"),
    ],
)
def test_says_what_is_wrong(tmp_path: Path, arguments, message):
    write([run(10.0, "method=omnigs", status="oom")], tmp_path)
    done = CliRunner().invoke(app, ["equal-time", *(a.format(runs=tmp_path) for a in arguments)])
    assert done.exit_code == 1 and message in done.stderr
