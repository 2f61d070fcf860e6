"""A multirun with launchers that only write states on the board."""

import io
import os
import signal
import threading
from dataclasses import replace
from types import SimpleNamespace

import pytest
from omegaconf import OmegaConf
from rich.console import Console
from support import made_up

from padgs import results
from padgs.multirun import slurm, sweep
from padgs.multirun.job import Board, JobState, in_own_process
from padgs.multirun.slurm import SubmissionRefused
from padgs.multirun.sweep import Multirun
from padgs.runs.interrupt import Interrupted

IN_PROCESS = "hydra._internal.core_plugins.basic_launcher.BasicLauncher"
ELSEWHERE = "hydra_plugins.hydra_joblib_launcher.joblib_launcher.JoblibLauncher"
JOBS = [["++seed=0"], ["++seed=1"], ["++seed=2"]]


class Start:
    """One start of the same sweep, and how often each of its jobs was launched."""

    def __init__(self, tmp_path, number: int, target: str, retry: str = "none", jobs=JOBS, given=()):
        self.runs, self.out = tmp_path / "runs", io.StringIO()
        self.folder = self.runs / ".multirun" / str(number)
        config = {
            "run": {"folder": str(self.runs)},
            "retry": retry,
            "tracking": {"kind": "none"},
            "hydra": {
                "sweep": {"dir": str(self.folder)},
                "launcher": {"_target_": target},
                "runtime": {"choices": {"experiment": "test"}},
                "overrides": {"hydra": [*given]},
            },
        }
        self.multirun = Multirun(OmegaConf.create(config), jobs, Console(file=self.out, width=200))
        self.board, self.launched = Board(self.folder), []

    def launch(self, jobs, initial_job_idx):
        """Stand in for a launcher of Hydra; subclasses choose how jobs end."""
        self.launched += [job[0] for job in jobs]
        for number, job in enumerate(jobs, initial_job_idx):
            self.end(number, job[0])

    def end(self, number: int, job: str) -> None:
        self.finish(number, job, "ok")

    def finish(self, number: int, job: str, status: str) -> None:
        run = f"room_{job[-1]}"
        (self.runs / run).mkdir(parents=True, exist_ok=True)
        (self.runs / run / "result.json").write_text("{}")
        self.board.write(number, JobState(status, run))

    def counts(self, batch_size: int | None = None) -> dict[str, int]:
        try:
            self.multirun.run(self, batch_size)
        finally:
            counts = self.multirun.close()
        return dict(counts)


@pytest.mark.parametrize("target", [IN_PROCESS, ELSEWHERE])
def test_a_second_start_launches_nothing(tmp_path, target):
    assert Start(tmp_path, 1, target).counts() == {"ok": 3}
    again = Start(tmp_path, 2, target)
    assert again.counts() == {"ok": 3} and again.launched == []
    assert again.out.getvalue() == "3 of 3 done (3 before)\n"
    assert not again.folder.exists()


class Scored(Start):
    def finish(self, number, job, status):
        super().finish(number, job, status)
        one = replace(made_up.result(), run=f"room_{job[-1]}", counts={"gaussians": 1234}, experiments=())
        results.write(one, self.runs / one.run)


@pytest.mark.parametrize("target", [IN_PROCESS, ELSEWHERE])
def test_each_run_has_a_line_that_says_what_differs_and_the_end_a_table_and_a_command(tmp_path, target):
    start = Scored(tmp_path, 1, target)
    start.counts()
    *lines, end = start.out.getvalue().split("3 of 3 done\n")
    assert [line for line in "".join(lines).splitlines() if line.startswith("seed = 1: ") and "1.23k gauss" in line]
    assert end.count("seed = ") == 3 and f"next: padgs report runs {start.runs}" in end
    again = Scored(tmp_path, 2, target)
    again.counts()
    assert again.out.getvalue().endswith(end), "finished before"


def test_jobs_with_configuration_files_from_elsewhere_are_looked_up(tmp_path):
    Start(tmp_path, 1, ELSEWHERE).counts()
    again = Start(tmp_path, 2, ELSEWHERE, given=["hydra.searchpath=[file:///mine]"])
    assert again.counts() == {"ok": 3} and len(again.launched) == 3


def test_an_unknown_choice_of_what_to_retry_is_refused(tmp_path):
    with pytest.raises(ValueError, match="unknown retry 'fail'; known: none, failed"):
        Start(tmp_path, 1, ELSEWHERE, retry="fail")


def test_one_job_at_a_time_runs_in_this_process():
    of = {"launcher": {"_target_": ELSEWHERE}}
    ours = [in_own_process(OmegaConf.merge(of, {"launcher": {"n_jobs": count}})) for count in (1, 2)]
    assert ours == [False, True] and in_own_process(OmegaConf.create(of))


def test_only_missing_jobs_are_launched(tmp_path):
    Start(tmp_path, 1, ELSEWHERE, jobs=JOBS[:2]).counts()
    more = Start(tmp_path, 2, ELSEWHERE)
    assert more.counts() == {"ok": 3} and more.launched == ["++seed=2"]


class Refusing(Start):
    def launch(self, jobs, initial_job_idx):
        if len(jobs) > self.most:
            raise SubmissionRefused(self.reason)
        super().launch(jobs, initial_job_idx)


@pytest.mark.parametrize(
    ("most", "batch_size", "reason", "counts"),
    [
        (2, 2, "", {"ok": 3}),
        (1, None, "Invalid job array specification", {"ok": 3}),
        (0, None, "invalid partition", {"refused": 3}),
    ],
)
def test_arrays_that_slurm_refuses_are_submitted_in_parts_if_that_may_help(
    tmp_path, capsys, most, batch_size, reason, counts
):
    start = Refusing(tmp_path, 1, ELSEWHERE)
    start.most, start.reason = most, reason
    assert start.counts(batch_size) == counts and (f"error: {reason}" in capsys.readouterr().err) == (
        "refused" in counts
    )


class Busy(Start):
    """Slurm takes as many jobs as `limits` say, one number a submission; None: it does not answer."""

    def launch(self, jobs, initial_job_idx):
        limit = self.limits.pop(0)
        if limit is None or len(jobs) > limit:
            raise SubmissionRefused("QOSMaxSubmitJobPerUserLimit" if limit else "Unable to contact slurm controller")
        self.sizes.append(len(jobs))
        super().launch(jobs, initial_job_idx)


def test_a_queue_that_is_full_or_silent_for_a_while_is_used_again(tmp_path, monkeypatch):
    monkeypatch.setattr(sweep, "SECONDS_BETWEEN_RETRIES", 0)
    start = Busy(tmp_path, 1, ELSEWHERE, jobs=[[f"++seed={n}"] for n in range(9)])
    start.limits, start.sizes = [None, None, 1, 2, 9, 9, 9], []
    assert start.counts(4) == {"ok": 9} and start.sizes == [2, 4, 3]
    lost = Busy(tmp_path / "2", 1, ELSEWHERE)
    lost.limits, lost.sizes = [None] * 100, []
    assert lost.counts() == {"refused": 3} and len(lost.limits) == 99 - sweep.RETRIES_OF_SLURM


@pytest.mark.parametrize("reason", ["QOSMaxSubmitJobPerUserLimit", "Socket timed out on send/recv operation"])
def test_a_queue_that_takes_no_job_for_a_while_is_tried_again(tmp_path, monkeypatch, reason):
    monkeypatch.setattr(sweep, "SECONDS_BETWEEN_RETRIES", 0)
    start = Refusing(tmp_path, 1, ELSEWHERE)
    limits = [0, 0, 0, 0, 9, 9]
    type(start).most = property(lambda self: limits.pop(0))
    start.reason = reason
    try:
        assert start.counts() == {"ok": 3}
    finally:
        del type(start).most


class OutOfMemory(Start):
    """The system kills the process of seed 1, and joblib all others with it."""

    def launch(self, jobs, initial_job_idx):
        self.launched.append([job[0][-1] for job in jobs])
        for number, (job,) in enumerate(jobs, initial_job_idx):
            self.board.write(number, JobState("running")) if ["++seed=1"] in jobs else self.end(number, job)
        if ["++seed=1"] in jobs:
            raise RuntimeError("a worker was killed")


def test_a_job_that_lacks_memory_takes_no_other_with_it_twice(tmp_path):
    start = OutOfMemory(tmp_path, 1, ELSEWHERE)
    assert start.counts() == {"ok": 2, "killed": 1} and start.launched == [["0", "1", "2"], ["0"], ["1"], ["2"]]


class Preempted(Start):
    def end(self, number, job):
        self.board.write(number, JobState("stopped", reason="stopped after iteration 5"))
        assert "1 stopped" in self.multirun.line()
        self.finish(number, job, "ok")  # Slurm has put it back into its queue
        assert "stopped" not in self.multirun.line()


def test_a_run_that_was_preempted_is_followed_to_its_end(tmp_path):
    assert Preempted(tmp_path, 1, ELSEWHERE).counts() == {"ok": 3}


class LeavesTheQueue(Start):
    def end(self, number, job):
        self.board.write(number, JobState("stopped", reason=sweep.LEFT_QUEUE))


def test_jobs_that_nobody_stopped_say_why_they_did_not_begin(tmp_path, capsys):
    start = LeavesTheQueue(tmp_path, 1, ELSEWHERE)
    assert start.counts() == {"stopped": 3} and start.folder.exists()
    assert capsys.readouterr().err.count("a node cannot write to run.folder") == 1


def test_slurm_jobs_are_followed_until_the_queue_has_none_of_them(tmp_path, monkeypatch):
    answers = [None, {"7_0", "7_1", "8"}, {"7_1"}, {"8"}]  # 8 is of somebody else; Slurm does not answer at first
    monkeypatch.setattr(slurm, "queued", lambda: answers.pop(0))
    monkeypatch.setattr(slurm, "SECONDS_BETWEEN_QUERIES", 0.0)
    cancelled = []
    monkeypatch.setattr(slurm, "cancel_pending", lambda ids: cancelled.extend(ids) or True)
    (tmp_path / "0").touch()
    jobs = [SimpleNamespace(job_id=f"7_{n}", paths=SimpleNamespace(stdout=tmp_path / str(n))) for n in range(2)]
    assert slurm.wait_for_jobs(jobs, lambda: len(answers) < 3) == [1], "the second left no output"
    assert not answers and cancelled == ["7_0", "7_1"], "asked once to take waiting jobs out of the queue"


class OneFails(Start):
    def end(self, number, job):
        self.finish(number, job, self.failure if job == "++seed=1" else "ok")


@pytest.mark.parametrize(("failure", "repeated"), [("nan", ["++seed=1"]), ("timeout", [])])
def test_failed_runs_are_retried_only_on_request_and_those_out_of_time_never(tmp_path, failure, repeated):
    first = OneFails(tmp_path, 1, ELSEWHERE)
    first.failure, counts = failure, {"ok": 2, failure: 1}
    assert first.counts() == counts and ("retry=failed" in first.out.getvalue()) == bool(repeated)
    kept = Start(tmp_path, 2, ELSEWHERE)
    assert kept.counts() == counts and kept.launched == []
    retried = Start(tmp_path, 3, ELSEWHERE, retry="failed")
    assert retried.counts() == ({"ok": 3} if repeated else counts) and retried.launched == repeated


class OneKills(Start):
    """Its second job takes the process down each time, together with whatever else runs there."""

    def end(self, number, job):
        self.board.write(number, JobState("running", f"room_{job[-1]}"))
        if job == "++seed=1":
            raise RuntimeError("a worker process was terminated")
        self.finish(number, job, "ok")


def test_a_job_whose_process_dies_ends_no_other_and_gets_a_second_chance(tmp_path, capsys):
    start = OneKills(tmp_path, 1, ELSEWHERE)
    assert start.counts() == {"ok": 2, "killed": 1}
    assert start.launched.count("++seed=1") == 2 and start.launched.count("++seed=0") == 1
    assert "a worker process was terminated" in capsys.readouterr().err
    assert start.folder.exists() and str(start.folder) in start.out.getvalue()  # what it said can be read there
    assert Start(tmp_path, 2, ELSEWHERE).counts() == {"ok": 3}  # there was no result, so it is still missing


class NeverStarts(Start):
    def launch(self, jobs, initial_job_idx):
        self.launched += [job[0] for job in jobs]
        raise RuntimeError("there is no such partition")


def test_a_launcher_that_starts_nothing_is_given_up(tmp_path, capsys):
    start = NeverStarts(tmp_path, 1, ELSEWHERE)
    assert start.counts() == {"refused": 3} and len(start.launched) == 3 * sweep.IDLE_LAUNCHES
    assert not start.folder.exists(), "no job began, so there is no output"
    assert capsys.readouterr().err.count("there is no such partition") == 1


class DiesAtFirst(Start):
    deaths = sweep.IDLE_LAUNCHES - 1

    def launch(self, jobs, initial_job_idx):
        if self.deaths:
            self.deaths -= 1
            raise RuntimeError("a worker process was terminated")
        super().launch(jobs, initial_job_idx)


def test_deaths_of_workers_before_any_job_began_count_for_no_job(tmp_path):
    assert DiesAtFirst(tmp_path, 1, ELSEWHERE).counts() == {"ok": 3}


class Refuses(Start):
    def end(self, number, job):
        self.board.write(number, JobState("refused", reason="the data set is not there"))


def test_an_error_of_all_jobs_is_printed_once(tmp_path, capsys):
    for target in (IN_PROCESS, ELSEWHERE):
        start = Refuses(tmp_path, 1, target)
        assert start.counts() == {"refused": 3} and start.out.getvalue().count("\n") == 1
        assert capsys.readouterr().err == "error: the data set is not there\n"


class AtWorkElsewhere(Start):
    def end(self, number, job):
        if job == "++seed=2":
            self.board.write(number, JobState("elsewhere", "room_2", "worked on by another process"))
        else:
            self.finish(number, job, "ok")


def test_a_job_of_another_process_counts_as_neither_failed_nor_done(tmp_path, capsys):
    start = AtWorkElsewhere(tmp_path, 1, ELSEWHERE)
    assert start.counts() == {"ok": 2, "elsewhere": 1}
    assert "2 of 3 done, 1 elsewhere" in start.out.getvalue()


class FinishedElsewhere(Scored):
    def end(self, number, job):
        self.finish(number, job, "ok")
        if job == "++seed=2":
            self.board.write(number, JobState("elsewhere", "room_2", "worked on by another process"))


@pytest.mark.parametrize("target", [IN_PROCESS, ELSEWHERE])
def test_a_run_that_another_process_finished_counts_and_is_looked_up_again(tmp_path, target):
    """It may lack the experiment of this multirun, and scores under its protocols."""
    start = FinishedElsewhere(tmp_path, 1, target)
    assert start.counts() == {"ok": 3}
    assert "3 of 3 done\n" in start.out.getvalue() and "seed = 2  " in start.out.getvalue().split("3 of 3 done\n")[-1]
    again = Scored(tmp_path, 2, target)
    assert again.counts() == {"ok": 3} and again.launched == ["++seed=2"]
    assert Scored(tmp_path, 3, target).multirun.jobs == [], "now all are known"


class Interrupts(Start):
    """Somebody presses Ctrl-C while the second job runs; it sees the board and stops, and the third does not start."""

    def end(self, number, job):
        if job == "++seed=0":
            return self.finish(number, job, "ok")
        if job == "++seed=1":
            os.kill(os.getpid(), signal.SIGINT)
            for _ in range(500):
                if (self.folder / "stop").exists():
                    break
                threading.Event().wait(0.01)
        assert (self.folder / "stop").exists()
        self.board.write(number, JobState("stopped", reason="stopped after iteration 5"))


def test_ctrl_c_lets_running_jobs_stop_by_themselves(tmp_path, monkeypatch):
    monkeypatch.setattr(sweep, "SECONDS_BETWEEN_TICKS", 0.01)
    start = Interrupts(tmp_path, 1, ELSEWHERE)
    with pytest.raises(Interrupted, match="running jobs wrote their checkpoints"):
        start.counts()
    assert dict(start.multirun.counts()) == {"ok": 1, "stopped": 2}
    again = Start(tmp_path, 2, ELSEWHERE)
    assert again.counts() == {"ok": 3} and again.launched == ["++seed=1", "++seed=2"]


class TerminalCloses(Start):
    def launch(self, jobs, initial_job_idx):
        self.launched += [job[0] for job in jobs]
        os.kill(os.getpid(), signal.SIGHUP)
        raise RuntimeError("a worker process was terminated")


def test_a_terminal_that_closes_while_workers_are_imported_launches_nothing_again(tmp_path):
    start = TerminalCloses(tmp_path, 1, ELSEWHERE)
    with pytest.raises(Interrupted):
        start.counts()
    assert len(start.launched) == 3


class InterruptsTwice(Start):
    def end(self, number, job):
        self.board.write(number, JobState("running", f"room_{job[-1]}"))
        raise KeyboardInterrupt


def test_a_second_ctrl_c_keeps_the_board(tmp_path):
    start = InterruptsTwice(tmp_path, 1, ELSEWHERE)
    with pytest.raises(KeyboardInterrupt):
        start.counts()
    assert (start.folder / "00000.json").exists() and str(start.folder) in start.out.getvalue()
    alone = InterruptsTwice(tmp_path, 2, IN_PROCESS)
    with pytest.raises(KeyboardInterrupt):
        alone.counts()
    assert not alone.folder.exists(), "its only process ends"


def test_a_folder_that_cannot_be_written_refuses_all_jobs(tmp_path, capsys):
    (tmp_path / "runs").write_text("a file where the folder should be")
    start = Start(tmp_path, 1, ELSEWHERE)
    assert start.counts() == {"refused": 3} and start.launched == []
    assert "cannot write run folder" in capsys.readouterr().err
