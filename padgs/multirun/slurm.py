"""Jobs in Slurm's queue: wait until they have left it, and remove those that have not begun."""

import re
import subprocess
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

SECONDS_BETWEEN_QUERIES = 10.0
NO_ANSWER = re.compile(r"unable to contact|temporarily|try again|timed out", re.IGNORECASE)  # and nothing was submitted
TOO_MANY = re.compile(r"array|limit", re.IGNORECASE)  # of MaxArraySize, a QOS or an account


class SubmissionRefused(Exception):
    """Slurm takes none of these jobs; it may take fewer if `TOO_MANY` finds a limit in the message."""


def wait_for_jobs(jobs: Sequence[Any], stop_requested: Callable[[], bool]) -> list[int]:
    """Wait until submitit's jobs have left the queue; if a stop is requested, take those that wait out of it.

    submitit asks `sacct`, which answers nothing on clusters without accounting, and takes preempted jobs for ended ones
    that Slurm has put back into the queue. Returns the positions of jobs that were cancelled before they began.
    """
    cancelled = False
    while (left := queued()) is None or left & {job.job_id for job in jobs}:
        if not cancelled and stop_requested():
            cancelled = cancel_pending(job.job_id for job in jobs)
        time.sleep(SECONDS_BETWEEN_QUERIES)
    return [position for position, job in enumerate(jobs) if not job.paths.stdout.exists()]


def queued() -> set[str] | None:
    """Return the ids of this user's jobs that wait or run, as JOB or JOB_INDEX; None if Slurm does not answer."""
    command = ["squeue", "--me", "--noheader", "--array", "--format=%i"]
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    return {*answer.stdout.split()} if answer.returncode == 0 else None


def cancel_pending(ids: Iterable[str]) -> bool:
    """Cancel the jobs that have not begun; return whether Slurm did so."""
    arrays = sorted({number.partition("_")[0] for number in ids})
    return subprocess.run(["scancel", "--state=PENDING", *arrays], capture_output=True, check=False).returncode == 0
