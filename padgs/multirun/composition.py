"""What Hydra makes of a command line, without running it; and the command line that a configuration comes from."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf, open_dict

from padgs.learning.method import Method
from padgs.multirun.choices import register_choices
from padgs.multirun.overrides import lenient, root
from padgs.runs.config import RunConfig, config_from_values
from padgs.runs.identity import labels
from padgs.runs.session import build

_PLAIN = re.compile(r"[\w./@:-]+")  # values that Hydra's grammar takes without quotes


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
    config = compose("config", lenient(settings), return_hydra_config=True)
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


def make_method(name: str = "padgs", *settings: str) -> Method:
    """An untrained method, as `padgs-run method=NAME SETTINGS` would train it.

    Args:
        name: a choice of `method`: any that the README lists.
        settings: as on the command line, of its options, rendering, loss or seed: "method.sh_degree=1", "seed=2".

    Raises:
        ConfigError: an unknown key, or a value that it cannot have.
        HydraException: there is no such method.
    """
    with composing():
        return build(configuration([f"method={name}", *settings]))


def settings_of(values: Mapping[str, Any], *choices: str) -> list[str]:
    """The choices, and the settings that turn `padgs-run CHOICES` into the run with these values; within `composing`.

    Raises:
        HydraException: there is no such choice.
    """
    return [*choices, *_changes(configuration(choices).values(), values)]


def command(settings: Sequence[str]) -> str:
    """`padgs-run` with settings, as a shell takes it."""
    return shlex.join(["padgs-run", *settings])


def _changes(given: Any, wanted: Any, key: str = "") -> Iterator[str]:
    if isinstance(given, Mapping) and isinstance(wanted, Mapping):
        for name in wanted:
            yield from _changes(given.get(name), wanted[name], f"{key}.{name}" if key else str(name))
    elif _plain(given) != _plain(wanted):
        yield f"{key}={_written(wanted)}"


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value  # what was read from JSON has no tuples


def _written(value: Any) -> str:
    """A value in Hydra's grammar."""
    if value is None:
        return "null"
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{key}:{_written(item)}" for key, item in value.items()) + "}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "[" + ",".join(map(_written, value)) + "]"
    if not isinstance(value, str) or _is_plain(value):
        return str(value)
    return "'" + value.replace("\\", "\\\\").replace("'", "\\'") + "'"


def _is_plain(text: str) -> bool:
    """Whether Hydra reads these letters as what they are, and not as a number, say."""
    return bool(_PLAIN.fullmatch(text)) and OverridesParser.create().parse_override(f"key={text}").value() == text
