"""What `padgs-run` does about a multirun; Hydra's own launchers run the jobs.

It differs from what Hydra's basic sweeper does in what users of sweeps ask for: what is finished is skipped without
being composed, what is wrong with one job ends no other, one looks at the whole while it runs, and Ctrl-C lets running
jobs write their checkpoints.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.config_loader import ConfigLoader
from hydra.core.plugins import Plugins
from omegaconf import DictConfig
from rich.console import Console

from padgs.multirun.multirun import Multirun
from padgs.multirun.overrides import expand

ENDS: Counter[str] = Counter()  # how the runs of the last multirun ended; Hydra's main returns nothing


def register() -> None:
    """Have Hydra sweep this way.

    It takes sweepers only from packages called `hydra_plugins`, so ours is its basic one with another method.
    """
    name = f"{BasicSweeper.__module__}.{BasicSweeper.__name__}"
    basic: Any = Plugins.instance().class_name_to_class[name]  # not the one above: finding plugins defines them anew
    basic.sweep = sweep


def sweep(self: BasicSweeper, arguments: list[str]) -> None:
    """Do what is missing of a multirun: all combinations of what is swept, each of them once.

    Args:
        self: has been set up by Hydra.
        arguments: the settings of the command line.

    Raises:
        Interrupted: stopped from outside; the same command goes on.
    """
    assert self.config is not None and self.launcher is not None and self.hydra_context is not None
    loader = self.hydra_context.config_loader
    multirun = Multirun(self.config, expand(self.params, arguments, loader), Console())
    _refuse_unknown_choices(multirun.jobs, self.config, loader)
    try:
        multirun.run(self.launcher, self.max_batch_size)
    finally:
        ENDS.clear()
        ENDS.update(multirun.close().counts)


def _refuse_unknown_choices(jobs: list[list[str]], config: DictConfig, loader: ConfigLoader) -> None:
    """Compose some jobs in which every choice of a group occurs, so that Hydra says which it does not know."""
    composed: set[str] = set()
    for job in jobs:
        choices = {setting for setting in job if not setting.startswith("++")}
        if not choices <= composed:
            loader.load_sweep_config(config, job)
            composed |= choices
