import resource
import subprocess
import sys
from dataclasses import replace

import pytest
from support.made_up import METHODS, compared, data_set, swept, write

RESULTS = 1000
SECONDS = 25.0  # of CPU time, 14 on two shared cores of an EPYC


def many() -> list:
    """Both data sets of the paper with 6 methods and 5 seeds, the built-in scenes, and five sweeps."""
    results = [
        replace(result, experiments=(experiment,))
        for dataset, experiment in (("roam360", "table1_360roam"), ("ricoh360", "table2_ricoh360"))
        for result in data_set(dataset, METHODS, seeds=5)
    ]
    results += compared(seeds=3)
    for key, count in (("tau", 8), ("lambda_l1", 6), ("voxel_size", 5), ("offsets", 4), ("resolution", 4)):
        results += swept(key, tuple(1.0 + i for i in range(count)), seeds=5)
    assert len(results) >= RESULTS - 10
    return [replace(result, run=f"{result.run}-{number}") for number, result in enumerate(results)]


@pytest.mark.slow
def test_everything_from_a_thousand_results_within_25_s(tmp_path, root):
    write(many(), tmp_path / "runs", renders=True)
    arguments = ["report", "all", tmp_path / "runs", "--out", tmp_path / "out"]
    before = _children()
    done = subprocess.run([sys.executable, "-m", "padgs.cli.app", *arguments], cwd=root, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "report.html").exists()
    spent = _children() - before
    assert spent < SECONDS


def _children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
