"""What `padgs-run` does about a multirun; Hydra's own launchers run the jobs.

It differs from what Hydra's basic sweeper does in what users of sweeps ask for: what is finished is skipped without
being composed, what is wrong with one job ends no other, one looks at the whole while it runs, and Ctrl-C lets running
jobs write their checkpoints.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

from hydra.core.config_loader import ConfigLoader
from hydra.core.plugins import Plugins
from hydra.plugins.sweeper import Sweeper
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from padgs.checks import typed
from padgs.multirun.board import REFUSED
from padgs.multirun.job import complain, job_of_many
from padgs.multirun.jobs import Multirun
from padgs.multirun.overrides import expand
from padgs.runs.config import RunOptions

ENDS: Counter[str] = Counter()  # how the runs of the last multirun ended; Hydra's main returns nothing


def register() -> None:
    """Have Hydra sweep this way.

    Ours is its basic sweeper with another method. A class of our own would have to stand in an installed package
    `hydra_plugins`, even if it is given to `Plugins.register`, and every program here that uses Hydra would import it.
    """
    (basic,) = (kind for kind in Plugins.instance().discover(Sweeper) if kind.__name__ == "BasicSweeper")
    basic.sweep = sweep  # type: ignore[attr-defined]


def sweep(self: Any, arguments: list[str]) -> None:
    """Do what is missing of a multirun: all combinations of what is swept, each of them once.

    Args:
        self: a basic sweeper that has been set up by Hydra, with a launcher that was given the job of a single run.
        arguments: the settings of the command line.

    Raises:
        Interrupted: stopped from outside; the same command goes on.
    """
    self.launcher.setup(hydra_context=self.hydra_context, task_function=job_of_many, config=self.config)
    loader = self.hydra_context.config_loader
    ENDS.clear()
    try:
        typed(RunOptions, OmegaConf.to_container(self.config.run, resolve=True), "run")  # type: ignore[arg-type]
        multirun = Multirun(self.config, expand(self.params, arguments, loader), Console())
    except ValueError as error:
        complain(str(error))
        ENDS[REFUSED] += 1
        return
    _refuse_unknown_choices(multirun.jobs, self.config, loader)
    try:
        multirun.run(self.launcher, self.max_batch_size)
    finally:
        ENDS.update(multirun.close().counts)


def _refuse_unknown_choices(jobs: list[list[str]], config: DictConfig, loader: ConfigLoader) -> None:
    """Compose some jobs in which every choice of a group occurs, so that Hydra says which it does not know."""
    composed: set[str] = set()
    for job in jobs:
        choices = {setting for setting in job if not setting.startswith("++")}
        if not choices <= composed:
            loader.load_sweep_config(config, job)
            composed |= choices
