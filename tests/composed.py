"""What Hydra makes of a command line, without running it."""

from contextlib import contextmanager

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf, open_dict

from padgs.cli.config import RunConfig, config_from_values
from padgs.cli.labels import labels
from padgs.cli.overrides import expand, lenient, root
from padgs.cli.run import register_fields


def composed(*overrides: str) -> RunConfig:
    """The typed configuration of `padgs-run OVERRIDES`."""
    with hydra_loader():
        return _config(overrides)


def jobs(*overrides: str) -> list[RunConfig]:
    """The typed configurations of all jobs that `padgs-run OVERRIDES` starts; one, if it is no multirun."""
    with hydra_loader() as loader:
        return [_config((*overrides, *job)) for job in _expanded(overrides, loader)]


def first_and_last_job(*overrides: str) -> list[RunConfig]:
    """Two of the jobs of `padgs-run OVERRIDES`, as unlike each other as they come."""
    with hydra_loader() as loader:
        found = _expanded(overrides, loader)
        return [_config((*overrides, *job)) for job in (found[0], found[-1])]


def expanded(*overrides: str) -> list[list[str]]:
    """What the jobs of `padgs-run OVERRIDES` differ in."""
    with hydra_loader() as loader:
        return _expanded(overrides, loader)


def _expanded(overrides, loader) -> list[list[str]]:
    config = compose("config", lenient(overrides), return_hydra_config=True)
    return expand(config.hydra.sweeper.params or {}, [], loader)


@contextmanager
def hydra_loader():
    register_fields()
    with initialize_config_dir(str(root() / "conf"), version_base="1.3"):
        yield GlobalHydra.instance().config_loader()


def _config(overrides) -> RunConfig:
    config = compose("config", lenient(overrides), return_hydra_config=True)
    choices = config.hydra.runtime.choices
    with open_dict(config):
        del config["hydra"]
    return config_from_values(OmegaConf.to_container(config, resolve=True), labels(choices))
