"""Compose configurations with Hydra, from files, tables and everything that the program knows by name."""

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from socket import gethostname
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from hydra.core.config_loader import ConfigLoader
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from padgs.baselines import BUILT_IN, METHODS, distribution
from padgs.checks import ConfigError, lookup
from padgs.data.perturb import CONDITIONS, NONE
from padgs.multirun.finished import FOLDER
from padgs.multirun.overrides import lenient, quoted, root
from padgs.runs.config import DEFAULT_METHOD, RunConfig, Settings, config_from_values, method_choices, scene_choices
from padgs.runs.console import say
from padgs.runs.run import Method, build_method
from padgs.runs.store import labels

# Hydra copies the store for every composition, which takes half of the time, and changes no copy.
ConfigStore.__deepcopy__ = lambda store, _: store  # type: ignore[attr-defined]
# At import, because jobs in processes of their own resolve what was composed elsewhere.
OmegaConf.register_new_resolver("is_dataset", lambda name, *, _root_: _root_.data.dataset == name, replace=True)


def gpus_for(device: str) -> int:
    """Return how many GPUs a run with this `run.device` asks a cluster for; auto: 1 if this machine has one."""
    return int(device == "cuda" or (device == "auto" and torch.cuda.is_available()))


OmegaConf.register_new_resolver("gpus_for", gpus_for, replace=True)
OmegaConf.register_new_resolver("gpus_of_slurm", lambda device: None if device == "cpu" else 1, replace=True)
_registered: list[tuple[Path, dict[str, Any]]] = []  # folder of `conf`, and methods, whose choices Hydra knows


@contextmanager
def composing() -> Iterator[ConfigLoader]:
    """Initialize Hydra for the functions below while the context lasts; yields the loader of configurations."""
    os.environ.setdefault("PADGS_ROOT", str(root()))
    register_choices()
    with initialize_config_dir(str(root() / "conf"), version_base="1.3"):
        yield GlobalHydra.instance().config_loader()


def multirun(arguments: Sequence[str]) -> DictConfig | None:
    """Compose a command line without what it sweeps; None if it is no multirun. It may raise a HydraException."""
    hydra = GlobalHydra.instance().hydra
    assert hydra is not None, "call within `composing`"
    forced = {"-m", "--multirun"} & {*arguments}
    settings = [text for text in lenient(quoted(arguments)) if text not in forced]
    settings += ["hydra.mode=MULTIRUN"] if forced else []
    settings.append(
        f"hydra.sweep.dir=${{run.folder}}/{FOLDER}/{datetime.now():%Y%m%d-%H%M%S}-{gethostname()}-{os.getpid()}"
    )
    config = hydra.compose_config("config", settings, RunMode.MULTIRUN, from_shell=False, with_log_configuration=False)
    return config if config.hydra.mode == RunMode.MULTIRUN else None


def configuration(settings: Sequence[str]) -> RunConfig:
    """Return the typed configuration of one run, within `composing`; raises a ConfigError or a HydraException."""
    composed = compose("config", lenient(quoted(settings)), return_hydra_config=True)
    return typed_config(composed, composed.hydra.runtime.choices)


def composed_text(settings: Sequence[str], key: str) -> str:
    """Return what Hydra composes under a key as YAML; "job" is all but Hydra's own keys."""
    composed = multirun(settings) or compose("config", lenient(quoted(settings)), return_hydra_config=True)
    if key == "job":
        return OmegaConf.to_yaml(OmegaConf.masked_copy(composed, [str(name) for name in composed if name != "hydra"]))
    if not OmegaConf.is_config(part := OmegaConf.select(composed, key)):
        raise ValueError(f"{key} is no group of the configuration; give job for all, or e.g. method or hydra.launcher")
    return OmegaConf.to_yaml(part)


def typed_config(composed: DictConfig, choices: Mapping[str, object]) -> RunConfig:
    """Return the typed configuration of what Hydra composed from these choices; it may raise a ConfigError."""
    values: Any = {
        key: OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value
        for key, value in composed.items()
        if key != "hydra"
    }
    _refuse_changed_rows(values, choices)
    _refuse_replaced_settings(choices)
    path, scene = values.get("data", {}).get("path"), choices.get("scene")
    known = scene_choices() | {file.stem: _table(file) for file in (root() / "conf" / "scene").glob("*.yaml")}
    if path is not None and "path" not in known.get(str(scene), {}).get("data", {"path": ""}):
        way_out = "leave out one, or add ~scene_set to an experiment that lists scenes"
        raise ConfigError(f"+scene={scene} generates a scene, but data.path={path} names a folder; {way_out}")
    return config_from_values(values, labels(choices))


def _refuse_changed_rows(values: Mapping[str, Any], choices: Mapping[str, object]) -> None:
    """Refuse a row of `conf/variants` that other settings have changed, because its name and title would be wrong."""
    for path in _variant_tables():
        chosen = name = choices.get(path.stem)
        rows, known = {} if chosen is None else _table(path), {}
        while isinstance(name, str):  # a row's own settings, then those of the row that it extends
            row = rows[name]
            own = {f"{group}.{key}": value for group, of in row.get("set", {}).items() for key, value in of.items()}
            known, name = {**row.get("choose", {}), **own, **known}, row.get("from")
        for setting, value in known.items():
            group, _, key = setting.partition(".")
            found = values.get(group, {}).get(key) if key else choices.get(group)
            if found != value:
                means = f"+{path.stem}={chosen} means {setting}={value}"
                raise ConfigError(f"{means}, but {setting}={found} was set besides; leave out one of the two")


def _refuse_replaced_settings(choices: Mapping[str, object]) -> None:
    """Refuse render=... or train=... where the method has such settings of its own, of which one would be lost."""
    for group in {"render", "train"} & {*choices}:
        method, chosen = str(choices["method"]), choices[group]
        if _settings_of(method, group) not in (None, chosen):
            file = root() / "conf" / group / f"{chosen}.yaml"
            keys = "".join(f" {group}.{key}={value}" for key, value in _table(file).items()) if file.exists() else ""
            why = f"{group}={chosen} is not for method={method}, which has own settings of {group}"
            raise ConfigError(f"{why}; {f'instead of it set{keys}' if keys else 'leave it out'}")


def _settings_of(method: str, group: str) -> str | None:
    """Return the choice of `render` or `train` that a method, or a file in `conf/method`, brings; None without one."""
    path = root() / "conf" / "method" / f"{method}.yaml"
    if not path.exists():
        return method if group in dict(method_choices(method)) else None
    file = _table(path)
    brought = "default" if file.get(group) else None
    for base in file["defaults"]:
        if isinstance(base, str) and not base.startswith("/"):
            brought = _settings_of(base, group) or brought
        elif isinstance(base, dict):
            brought = base.get(f"override /{group}", brought)
    return brought


def make_method(name: str = DEFAULT_METHOD, *settings: str) -> Method:
    """Return an untrained method, as `padgs-run method=NAME SETTINGS` would train it.

    Settings are as on the command line, of its options, rendering, loss or seed: "method.sh_degree=1", "seed=2".
    It may raise a ConfigError, or a HydraException for an unknown method.
    """
    with composing():
        return build_method(configuration([f"method={name}", *settings]))


def register_choices() -> None:
    """Register the keys and defaults of dataclasses with Hydra, and the choices of groups that have no file, once.

    A method of another package that cannot be imported is reported once and removed from METHODS.
    """
    if _registered == [(root(), {**METHODS})]:
        return
    OmegaConf.register_new_resolver("all_conditions", lambda: ",".join((NONE, *CONDITIONS)), replace=True)
    store = ConfigStore.instance()
    store.store(name="fields", node=asdict(Settings()))
    for method in [*METHODS]:
        try:
            keys = {"name": method, **asdict(lookup(METHODS, method, "method").Options())}
            has_file = (root() / "conf" / "method" / f"{method}.yaml").exists()
            nodes = [] if has_file else [*method_choices(method)]
        except (Exception, SystemExit) as error:  # of any kind: that package is not ours
            if method in BUILT_IN:
                raise
            del METHODS[method]
            why = f"{type(error).__name__}: {error}; repair {distribution(method)}, or uninstall it"
            say(Console(stderr=True), f"method={method} is left out ({why})", "yellow")
            continue
        store.store(group="fields/method", name=method, node=keys)
        for group, node in nodes:
            store.store(group=group, name=method, node=node, package="_global_")
    for group, rows in {"scene": scene_choices(), **variant_choices(), **set_choices()}.items():
        for name, node in rows.items():
            store.store(group=group, name=name, node=node, package="_global_")
    _registered[:] = [(root(), {**METHODS})]


def variant_choices() -> dict[str, dict[str, dict[str, Any]]]:
    """Return group -> name -> node for each table in `conf/variants`.

    >>> variant_choices()["ablation"]["a2_distance"]
    {'defaults': ['a1_anchors'], 'variant': 'a2_distance', 'method': {'use_distance': True}}
    """

    def node(name: str, row: dict[str, Any]) -> dict[str, Any]:
        extended = [row["from"]] if "from" in row else []
        chosen = [{f"override /{group}": choice} for group, choice in row.get("choose", {}).items()]
        return {"defaults": [*extended, *chosen], "variant": name, **row.get("set", {})}

    return {path.stem: {name: node(name, row) for name, row in _table(path).items()} for path in _variant_tables()}


def _variant_tables() -> list[Path]:
    return sorted((root() / "conf" / "variants").glob("*.yaml"))


def set_choices() -> dict[str, dict[str, dict[str, Any]]]:
    """Return group -> NAME_SCALE -> node for each list of scenes, methods or lengths in `conf/sets.yaml`.

    >>> set_choices()["scene_set"]["bar_cpu"]
    {'hydra': {'sweeper': {'params': {'+scene': 'synthetic_room'}}}}
    """
    return {
        group: {
            f"{name}_{scale}": {"hydra": {"sweeper": {"params": {rows["key"]: values}}}}
            for name, by_scale in rows.items()
            if name != "key"
            for scale, values in by_scale.items()
        }
        for group, rows in _table(root() / "conf" / "sets.yaml").items()
    }


def _table(path: Path) -> dict[str, dict[str, Any]]:
    return OmegaConf.to_container(OmegaConf.load(path))  # type: ignore[return-value]
