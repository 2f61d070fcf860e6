from pathlib import Path
from types import SimpleNamespace

import pytest
from hydra.errors import HydraException
from rich.console import Console
from support.composed import composed

from padgs.multirun import job
from padgs.multirun.job import TrackedRun, exit_on_errors
from padgs.training.health import Failure


def test_a_run_in_progress_is_mirrored_at_intervals(tmp_path, monkeypatch):
    looks = []
    monkeypatch.setattr(job, "Tracker", lambda *_: SimpleNamespace(update=looks.append))
    watch = TrackedRun(composed(), Console())
    watch.saved(tmp_path)
    assert looks == []
    monkeypatch.setattr(job, "SECONDS_BETWEEN_LOOKS", 0.0)
    watch.saved(tmp_path)
    watch.ended(SimpleNamespace(run="room"))
    assert looks == [tmp_path, Path("runs/room")]


@pytest.mark.parametrize(
    "error", [Failure("oom", "no memory for a search"), ValueError("no such data"), HydraException("no such choice")]
)
def test_expected_errors_are_reported_without_a_traceback(capsys, error):
    with pytest.raises(SystemExit, match="1"), exit_on_errors():
        raise error
    assert capsys.readouterr().err == f"error: {error}\n"
