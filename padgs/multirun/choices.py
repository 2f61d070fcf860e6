"""Choices of groups that no file in `conf/` holds: every method and every scene that the program knows by name."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf
from rich.console import Console

from padgs.baselines import METHODS, OURS, distribution
from padgs.data.datasets import DATASETS
from padgs.data.synthetic.options import SCENES
from padgs.multirun.overrides import root
from padgs.registry import lookup
from padgs.render import RenderConfig
from padgs.runs.config import default_fields, method_fields
from padgs.runs.console import say
from padgs.training.options import TrainOptions


def register_choices() -> None:
    """Tell Hydra the keys and defaults of the dataclasses, so that files and commands only name what differs.

    A method of another package that cannot be had is said once, and from then on there is none of its name.
    """
    store = ConfigStore.instance()
    store.store(name="fields", node=default_fields())
    for method in [*METHODS]:
        try:
            keys, nodes = method_fields(method), [*method_choices(method)]
        except Exception as error:  # of any kind: that package is not ours
            if method in OURS:
                raise
            del METHODS[method]
            why = f"{type(error).__name__}: {error}; mend {distribution(method)}, or uninstall it"
            say(Console(stderr=True), f"method={method} is left out ({why})", "yellow")
            continue
        store.store(group="fields/method", name=method, node=keys)
        for group, node in nodes:
            store.store(group=group, name=method, node=node, package="_global_")
    for group, rows in {"scene": scene_choices(), **variant_choices(), **set_choices()}.items():
        for name, node in rows.items():
            store.store(group=group, name=name, node=node, package="_global_")


def method_choices(name: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Group and node of `method=NAME`, and of what it brings: how it is drawn and trained, where that is its own.

    Those are choices as well, so that render=... and train=... on a command line replace them. Nothing of a method that
    has a file in conf/method, which says more.

    >>> list(method_choices("op43dgs"))[0]
    ('render', {'render': {'projection': 'tangent'}})
    """
    if (root() / "conf" / "method" / f"{name}.yaml").exists():
        return
    kind = lookup(METHODS, name, "method")
    defaults: list[Any] = [f"/fields/method/{name}@method"]
    for group, own, usual in (("render", kind.RENDER, RenderConfig()), ("train", kind.TRAIN, TrainOptions())):
        changes = {key: value for key, value in asdict(own).items() if value != getattr(usual, key)}
        if changes:
            yield group, {group: changes}
            defaults.append({f"override /{group}": name})
    yield "method", {"defaults": defaults}


def scene_choices() -> dict[str, dict[str, Any]]:
    """Choice of `+scene=` -> what it sets; named <data set>_<scene>, so that a sweep can say `+scene=glob(roam360_*)`.

    >>> scene_choices()["ricoh360_cat_tower"]
    {'defaults': [{'override /data': 'ricoh360'}], 'data': {'path': 'data/ricoh360/cat_tower'}}
    >>> scene_choices()["synthetic_outdoor"]
    {'defaults': [{'override /data': 'synthetic'}], 'data': {'generator': {'scene': 'outdoor'}}}
    """
    built_in = {f"synthetic_{scene}": _scene("synthetic", {"generator": {"scene": scene}}) for scene in SCENES}
    published = {
        f"{name}_{scene}": _scene(name, {"path": f"data/{known.title.casefold()}/{scene}"})
        for name, known in DATASETS.items()
        for scene in known.scenes
    }
    return {**built_in, **published}


def variant_choices() -> dict[str, dict[str, dict[str, Any]]]:
    """Return group -> name -> node for each table in `conf/variants`.

    >>> variant_choices()["ablation"]["a2_distance"]
    {'defaults': ['a1_anchors'], 'variant': 'a2_distance', 'method': {'use_distance': True}}
    """
    return {
        path.stem: {name: _variant(name, row) for name, row in _table(path).items()}
        for path in sorted((root() / "conf" / "variants").glob("*.yaml"))
    }


def _variant(name: str, row: dict[str, Any]) -> dict[str, Any]:
    extended = [row["from"]] if "from" in row else []
    chosen = [{f"override /{group}": choice} for group, choice in row.get("choose", {}).items()]
    return {"defaults": [*extended, *chosen], "variant": name, **row.get("set", {})}


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


def _scene(data: str, values: dict[str, Any]) -> dict[str, Any]:
    return {"defaults": [{"override /data": data}], "data": values}
