"""reports/measure_gpu.sh with fake programs: the order of its steps, and where it continues."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[3] / "reports" / "measure_gpu.sh"
PYTHON = f"""#!/bin/sh
case "$*" in
  *"-m pytest"*) echo "tests $TOOL" >> "$CALLS"; test -z "$BROKEN" ;;
  *"bench --device cuda"*)
    echo bench >> "$CALLS"
    for out; do :; done  # the last argument
    echo '{{"machine": {{"gpu": "Some GPU"}}}}' > "$out/bench.json" ;;
  *) exec {sys.executable} "$@" ;;
esac
"""


@pytest.fixture
def measure(tmp_path: Path):
    """Run the script and return its last line and the calls that it made."""
    (tmp_path / "reports").mkdir()
    shutil.copy(SCRIPT, tmp_path / "reports")
    (tmp_path / "build/gpu/padgs").mkdir(parents=True)
    calls, programs = tmp_path / "calls", tmp_path / "programs"
    programs.mkdir()
    fakes = {
        "python": PYTHON,
        "cmake": '#!/bin/sh\necho "cmake $1" >> "$CALLS"\ntest "$1" != "$BROKEN"\n',
        "compute-sanitizer": '#!/bin/sh\nexport TOOL=$2\nshift 4\nexec "$@"\n',
    }
    for name, text in fakes.items():
        (programs / name).write_text(text)
        (programs / name).chmod(0o755)

    def run(*steps: str, **variables: str) -> tuple[str, list[str]]:
        calls.write_text("")
        environment = {
            **{"PATH": f"{programs}:{os.environ['PATH']}", "PYTHON": str(programs / "python"), "CALLS": str(calls)},
            **{"BROKEN": "", **variables},
        }
        command = [str(tmp_path / "reports" / SCRIPT.name), *steps]
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        return (done.stdout + done.stderr).splitlines()[-1], calls.read_text().split("\n")[:-1]

    return run


def test_the_benchmark_comes_first_and_finished_steps_are_skipped(measure, tmp_path: Path):
    line, calls = measure("build", "bench")
    assert calls == ["cmake -S", "cmake --build", "bench"]
    assert line.startswith("verified: build bench; not verified: kernels (not run), tests (not run), memcheck")
    line, calls = measure()
    assert calls == [
        "tests ",
        "tests ",
        *(f"tests {tool}" for tool in ("memcheck", "synccheck", "racecheck", "initcheck") for _ in range(4)),  # files
    ]
    assert line.endswith("racecheck initcheck; not verified: nothing")
    assert measure()[1] == []
    (tmp_path / "build/gpu/out/memcheck.state").unlink()
    assert "not verified: memcheck (failed" in measure(BROKEN="yes")[0], "one file that fails fails the step"
    measure()
    assert json.loads((tmp_path / "reports/measured/some-gpu.json").read_text())["steps"]["racecheck"] == "ok"


def test_failed_steps_are_named_and_repeated_and_unknown_ones_refused(measure):
    line, _ = measure("build", "bench", "kernels", "tests", BROKEN="yes")
    assert "verified: build bench; not verified: kernels (failed (1)), tests (failed (1))" in line
    line, calls = measure("tests")
    assert calls == ["tests "] and line.startswith("verified: build bench tests;")
    assert measure("racechek")[0].startswith("unknown step racechek; known: build bench kernels tests")


def test_a_failed_configuration_ends_the_build(measure):
    line, calls = measure("build", BROKEN="-S")
    assert calls == ["cmake -S"] and "not verified: build (failed (1))" in line
