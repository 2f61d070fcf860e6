"""What Hydra makes of a command line, without running it."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, OmegaConf, open_dict

from padgs.multirun.choices import register_choices
from padgs.multirun.overrides import lenient, quoted, root
from padgs.runs.config import DEFAULT_METHOD, RunConfig, config_from_values
from padgs.runs.run import build_method
from padgs.runs.store import labels
from padgs.training.method import Method


@contextmanager
def composing() -> Iterator[ConfigLoader]:
    """Within it `configuration` can be called; yields what knows the choices of groups."""
    os.environ.setdefault("PADGS_ROOT", str(root()))
    register_choices()
    with initialize_config_dir(str(root() / "conf"), version_base="1.3"):
        yield GlobalHydra.instance().config_loader()


def configuration(settings: Sequence[str]) -> RunConfig:
    """The typed configuration of `padgs-run SETTINGS`, which is no multirun; to be called within `composing`.

    Raises:
        ConfigError: an unknown key or name, or a value of the wrong type.
        HydraException: no such choice, or no sentence of Hydra's grammar.
    """
    config = compose("config", lenient(quoted(settings)), return_hydra_config=True)
    choices = config.hydra.runtime.choices
    with open_dict(config):
        del config["hydra"]
    return typed_config(config, choices)


def typed_config(composed: DictConfig, choices: Mapping[str, object]) -> RunConfig:
    """The configuration of a run, from what Hydra composed of these choices.

    Raises:
        ConfigError: as above.
    """
    values: Any = OmegaConf.to_container(composed, resolve=True)
    return config_from_values(values, labels(choices))


def make_method(name: str = DEFAULT_METHOD, *settings: str) -> Method:
    """An untrained method, as `padgs-run method=NAME SETTINGS` would train it.

    Args:
        name: a choice of `method`: any that the README lists.
        settings: as on the command line, of its options, rendering, loss or seed: "method.sh_degree=1", "seed=2".

    Raises:
        ConfigError: an unknown key, or a value that it cannot have.
        HydraException: there is no such method.
    """
    with composing():
        return build_method(configuration([f"method={name}", *settings]))
