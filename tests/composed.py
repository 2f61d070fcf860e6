"""What Hydra makes of a command line, without running it."""

import itertools

from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from padgs.cli.config import RunConfig, config_from_values
from padgs.cli.run import lenient, register_fields, root


def composed(*overrides: str) -> RunConfig:
    """The typed configuration of `padgs-run OVERRIDES`."""
    return config_from_values(_values(overrides))


def jobs(*overrides: str) -> list[RunConfig]:
    """The typed configurations of all jobs that `padgs-run OVERRIDES` starts; one, if it is no multirun."""
    params = _values(overrides, with_hydra=True)["hydra"]["sweeper"]["params"]
    choices = [[f"{key}={value}" for value in str(values).split(",")] for key, values in params.items()]
    return [composed(*overrides, *job) for job in itertools.product(*choices)]


def _values(overrides, *, with_hydra: bool = False) -> dict:
    register_fields()
    with initialize_config_dir(str(root() / "conf"), version_base="1.3"):
        config = compose("config", lenient(list(overrides)), return_hydra_config=with_hydra)
        if with_hydra:
            return {"hydra": {"sweeper": {"params": dict(config.hydra.sweeper.params or {})}}}
        return OmegaConf.to_container(config, resolve=True)
