"""The `scene` group: every scene that the program knows by name, so that a sweep can say `+scene=glob(roam360_*)`."""

from __future__ import annotations

from typing import Any

from padgs.data.datasets import DATASETS
from padgs.data.synthetic.options import SCENES


def scene_choices() -> dict[str, dict[str, Any]]:
    """Choice -> what it sets; named <data set>_<scene>.

    >>> scene_choices()["ricoh360_cat_tower"]
    {'defaults': [{'override /data': 'ricoh360'}], 'data': {'path': 'data/ricoh360/cat_tower'}}
    >>> scene_choices()["synthetic_outdoor"]
    {'defaults': [{'override /data': 'synthetic'}], 'data': {'generator': {'scene': 'outdoor'}}}
    """
    built_in = {f"synthetic_{scene}": _node("synthetic", {"generator": {"scene": scene}}) for scene in SCENES}
    published = {
        f"{name}_{scene}": _node(name, {"path": f"data/{known.title.casefold()}/{scene}"})
        for name, known in DATASETS.items()
        for scene in known.scenes
    }
    return {**built_in, **published}


def _node(data: str, values: dict[str, Any]) -> dict[str, Any]:
    return {"defaults": [{"override /data": data}], "data": values}
