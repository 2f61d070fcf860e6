from padgs.multirun.job import TrackedRun


def test_a_run_in_progress_is_not_looked_at_all_the_time(tmp_path):
    looks = []
    watch = TrackedRun(type("Fake", (), {"update": lambda self, run: looks.append(run)})())
    watch.started(tmp_path, 10)
    watch.saved(tmp_path)
    assert looks == []
    watch.finished()
    assert looks == [tmp_path]
