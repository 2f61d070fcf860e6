"""Kill `padgs-run` and `padgs report` at random moments, again and again; every end must be the same, bit by bit.

    python tests/support/kills.py 100 --seed 7

One process imports everything once and forks a child for each attempt, so a kill costs no more than what it cuts off.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from padgs import results
from padgs.cli.commands import app
from padgs.multirun import job, run, sweep  # noqa: F401 - before the first fork
from padgs.runs import checkpoint
from padgs.runs import run as pipeline  # noqa: F401
from support.tiny_run import SMALLEST

TINY = [*SMALLEST, "train.iterations=60", "run.checkpoint_every=5", "run.probe_every=20", "tracking=none"]
TIMES = re.compile(r'"(cpu_)?seconds": [0-9.]+')


@dataclass(frozen=True)
class Work:
    """Something that can be killed: a command, what it leaves, and how long it takes undisturbed."""

    name: str
    arguments: tuple[str, ...]  # without the folder
    program: Callable[[], None]
    where: str  # how the folder is named
    seconds: float = 0.0

    def start(self, folder: Path) -> int:
        """Process id of a child that does it; what is there already stays."""
        if pid := os.fork():
            return pid
        with open(folder.parent / f"{folder.name}.said", "ab", buffering=0) as said:
            os.dup2(said.fileno(), 1)
            os.dup2(said.fileno(), 2)
        sys.argv = [self.name, *self.arguments, f"{self.where}{folder}"]
        code = 1
        try:
            self.program()
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
        finally:
            os._exit(code)

    def finish(self, folder: Path) -> None:
        """Do it to its end."""
        _, status = os.waitpid(self.start(folder), 0)
        if code := os.waitstatus_to_exitcode(status):
            said = (folder.parent / f"{folder.name}.said").read_text()[-2000:]
            raise AssertionError(f"{self.name} in {folder} ended with {code}: {said}")


def content(folder: Path) -> dict[str, object]:
    """All that must be the same: marks, checkpoints and logs of runs without times, and the bytes of other files."""
    found: dict[str, object] = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if not path.is_file() or "multirun" in name or path.suffix == ".lock" or path.parent.name == "checkpoint":
            continue
        if path.name.startswith("."):  # what a kill left half-written beside the file it was to become
            continue
        if path.name == "log.jsonl":
            found[name] = TIMES.sub("", path.read_text())
        elif path.name == results.FILE_NAME:
            made = results.read(path)
            found[name] = made.run, made.status, made.scores, made.counts, made.iterations_done
            state = checkpoint.load(path.parent / "checkpoint")
            found[f"{name} state"] = {key: tensor.numpy().tobytes() for key, tensor in state.tensors.items()}
        elif path.name != "config.yaml":  # has the folder in it
            found[name] = path.read_bytes()
    return found


def hammered(kills: int, seed: int, place: Path) -> Counter[str]:
    """Kill so many times; how often each work was killed, and how often it then came to its end.

    Raises:
        AssertionError: an end differs from that of undisturbed work, or work that nobody killed failed.
    """
    source, runs = random.Random(seed), place / "runs"
    works = [
        Work("run", (*TINY, "method=padgs"), run.main, "run.folder="),
        Work("sweep", ("-m", *TINY, "method=omnigs,padgs_plus"), run.main, "run.folder="),
        Work("report", ("report", "all", str(runs)), app, "--out="),
    ]
    expected = {}
    for number, work in enumerate(works):
        for folder in (runs if work.name == "sweep" else place / work.name, place / f"{work.name}-again"):
            started = time.monotonic()
            work.finish(folder)
        expected[work.name] = content(folder)  # of the second time, which took what it takes with warm caches
        works[number] = replace(work, seconds=time.monotonic() - started)
        if not expected[work.name]:
            raise AssertionError(f"{work.name} left nothing to compare")
    counts: Counter[str] = Counter()

    def ended(work: Work, folder: Path) -> None:
        work.finish(folder)
        if (there := content(folder)) != expected[work.name]:
            names = [n for n in {*there, *expected[work.name]} if there.get(n) != expected[work.name].get(n)]
            said = (folder.parent / f"{folder.name}.said").read_text()[-4000:]
            raise AssertionError(f"{work.name} in {folder} differs in {', '.join(sorted(names))}; it said: {said}")
        shutil.rmtree(folder)
        counts[f"{work.name} ended alike"] += 1

    for kill in range(kills):
        work = works[kill % len(works)]
        folder = place / f"killed-{work.name}"
        pid = work.start(folder)
        time.sleep(source.uniform(0, work.seconds))
        os.kill(pid, signal.SIGKILL)
        _, status = os.waitpid(pid, 0)
        counts[f"{work.name} killed"] += os.waitstatus_to_exitcode(status) == -signal.SIGKILL
        if source.random() < 0.1:
            ended(work, folder)
    for work in works:
        ended(work, place / f"killed-{work.name}")
    return counts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kills", type=int)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    folder = tempfile.mkdtemp(prefix="padgs-kills-")  # stays where something differs
    os.environ["PADGS_CACHE"] = f"{folder}/cache"
    for name, count in sorted(hammered(asked.kills, asked.seed, Path(folder)).items()):
        print(f"{name}: {count}")
    shutil.rmtree(folder)


if __name__ == "__main__":
    main()
