"""`padgs-run`: one run, or a multirun of many, composed by Hydra from `conf/`."""

from __future__ import annotations

import os
import shlex
import sys
import tempfile
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from baselines import METHODS
from padgs.checkpoint import CheckpointError
from padgs.cli import session
from padgs.cli.config import config_from_values, default_fields, method_fields
from padgs.cli.interrupt import Interrupted
from padgs.cli.labels import labels
from padgs.cli.overrides import lenient, root
from padgs.cli.run_folder import RunFolderError
from padgs.cli.scenes import scene_choices

EXPECTED = (ValueError, OSError, CheckpointError, RunFolderError)  # say what to do; a traceback would only hide it
INTERRUPTED = 130  # exit code of a command that Ctrl-C ended


def register_fields() -> None:
    """Tell Hydra the keys and defaults of the dataclasses, so that files and commands only name what differs."""
    store = ConfigStore.instance()
    store.store(name="fields", node=default_fields())
    for method in METHODS:
        store.store(group="fields/method", name=method, node=method_fields(method))
    for name, scene in scene_choices().items():
        store.store(group="scene", name=name, node=scene, package="_global_")


def main() -> None:
    """Entry point of `padgs-run`; exit code 0, 1 if any run failed, 130 if stopped by Ctrl-C."""
    os.environ.setdefault("PADGS_ROOT", str(root()))
    register_fields()
    command = shlex.join(["padgs-run", *sys.argv[1:]])
    sys.argv[1:] = lenient(sys.argv[1:])
    console, errors = Console(), Console(stderr=True)
    failed: list[str] = []
    said: set[str] = set()  # a missing data set is missing for all rows of a table; once is enough

    def one(composed: DictConfig) -> str:
        """One run; what is wrong with it is said here, so that it ends no other run of a multirun."""
        try:
            values: Any = OmegaConf.to_container(composed, resolve=True)
            result = session.run(config_from_values(values, labels(HydraConfig.get().runtime.choices)), console)
        except EXPECTED as error:
            if os.environ.get("HYDRA_FULL_ERROR"):
                raise
            if str(error) not in said:
                errors.print(f"error: {error}", style="red", markup=False, highlight=False, soft_wrap=True)
            said.add(str(error))
            failed.append("rejected")
            return "rejected"
        if not result.ok:
            failed.append(result.status)
        return result.status

    try:
        with tempfile.TemporaryDirectory() as scratch:  # Hydra insists on writing down the overrides of a multirun
            sys.argv.insert(1, f"hydra.sweep.dir={scratch}")
            hydra.main(version_base="1.3", config_path=str(root() / "conf"), config_name="config")(one)()
    except (Interrupted, KeyboardInterrupt) as stopped:
        reason = str(stopped) or "stopped"
        errors.print(f"{reason}; to go on: {command}", markup=False, highlight=False, soft_wrap=True)
        sys.exit(INTERRUPTED)
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
