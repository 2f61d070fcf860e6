"""What Hydra makes of a command line, without running it."""

import copy
import functools
import os

from hydra import compose

from padgs.baselines import METHODS
from padgs.multirun.composition import composing, configuration
from padgs.multirun.overrides import expand, lenient
from padgs.runs.config import RunConfig


def composed(*overrides: str) -> RunConfig:
    """The typed configuration of `padgs-run OVERRIDES`."""
    return copy.deepcopy(_composed(overrides, tuple(METHODS), os.environ.get("PADGS_ROOT"), os.environ.get("HOME")))


@functools.cache
def _composed(overrides: tuple[str, ...], *_surroundings: object) -> RunConfig:
    with composing():
        return configuration(overrides)


def jobs(*overrides: str) -> list[RunConfig]:
    """The typed configurations of all jobs that `padgs-run OVERRIDES` starts; one, if it is no multirun."""
    with composing() as loader:
        return [configuration((*overrides, *job)) for job in _expanded(overrides, loader)]


def first_and_last_job(*overrides: str) -> list[RunConfig]:
    """Two of the jobs of `padgs-run OVERRIDES`, as unlike each other as they come, or the only one."""
    with composing() as loader:
        found = _expanded(overrides, loader)
        return [configuration((*overrides, *job)) for job in dict.fromkeys(map(tuple, (found[0], found[-1])))]


def expanded(*overrides: str) -> list[list[str]]:
    """What the jobs of `padgs-run OVERRIDES` differ in."""
    with composing() as loader:
        return _expanded(overrides, loader)


def _expanded(overrides, loader) -> list[list[str]]:
    config = compose("config", lenient(overrides), return_hydra_config=True)
    return expand(config.hydra.sweeper.params or {}, [], loader)
