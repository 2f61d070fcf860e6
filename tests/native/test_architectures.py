"""Architectures of libpadgs_cuda, chosen by CMake from the output of nvcc and nvidia-smi; both are faked here."""

import shutil
import subprocess
from pathlib import Path

import pytest

from padgs.native import cuda

SCRIPT = Path(cuda.__file__).parent / "csrc" / "cuda" / "architectures.cmake"
pytestmark = pytest.mark.skipif(shutil.which("cmake") is None, reason="no cmake")


def program(folder: Path, name: str, *lines: str) -> str:
    """Write a program that prints these lines."""
    path = folder / name
    path.write_text("#!/bin/sh\n" + "".join(f"echo {line}\n" for line in lines))
    path.chmod(0o755)
    return str(path)


@pytest.mark.parametrize(
    ("asked", "gpus", "architectures", "problem"),
    [
        ("native", ["9.0"], "90", ""),
        ("native", ["12.0", "8.9", "12.0"], "89;120", ""),
        ("native", ["No devices were found"], "", "nvidia-smi finds no GPU here"),
        ("native", ["13.5"], "135", "nvcc does not know compute capability 135; it knows 75, 80, 89, 90, 120"),
        ("native", ["6.1", "8.9"], "89", ""),
        ("90;80", [], "80;90", ""),
        ("all", [], "75;80;89;90;120", ""),
        ("90;35", [], "35;90", "nvcc does not know compute capability 35; it knows 75, 80, 89, 90, 120"),
    ],
)
def test_architectures(asked, gpus, architectures, problem, tmp_path: Path):
    nvcc = program(tmp_path, "nvcc", "compute_75", "compute_80", "compute_89", "compute_90", "compute_120")
    program(tmp_path, "nvidia-smi", *gpus)
    found, told = chosen(nvcc, asked, tmp_path)
    assert found == architectures and problem in told and bool(problem) == bool(told)


@pytest.mark.parametrize(("release", "problem"), [("11.5", "is of CUDA 11.5"), ("11.8", ""), ("13.0", "")])
def test_a_compiler_without_matrix_transpose_is_refused(release, problem, tmp_path: Path):
    found, told = chosen(program(tmp_path, "nvcc", "compute_80", f"release {release}, V{release}.1"), "80", tmp_path)
    assert found == "80" and problem in told and bool(problem) == bool(told)


def chosen(nvcc: str, asked: str, tmp_path: Path) -> list[str]:
    """Return the architectures and the problem, if any."""
    script = tmp_path / "ask.cmake"
    script.write_text(
        f'include("{SCRIPT}")\nchoose_architectures({nvcc} "{asked}")\n'
        'message(STATUS "found ${architectures} | ${problem}")\n'
    )
    done = subprocess.run(
        [str(shutil.which("cmake")), "-P", str(script)],
        env={"PATH": f"{tmp_path}:/usr/bin:/bin"},
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout.removeprefix("-- found ").rstrip("\n").split(" | ")
