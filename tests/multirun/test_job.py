from padgs.multirun import job
from padgs.multirun.job import TrackedRun


def test_a_run_in_progress_is_not_looked_at_all_the_time(tmp_path, monkeypatch):
    looks = []
    watch = TrackedRun(type("Fake", (), {"update": lambda self, run: looks.append(run)})())
    watch.saved(tmp_path)
    assert looks == []
    monkeypatch.setattr(job, "SECONDS_BETWEEN_LOOKS", 0.0)
    watch.saved(tmp_path)
    assert looks == [tmp_path]
