"""Panoramic Gaussian splatting with a distortion map, and the means to compare it fairly.

For a notebook:

    load_scene      a data set, or without a path the generated room
    make_method     an untrained method by its name; `fit`, then `render`
    Budget          for how long to train
    draw            what a trained method shows of a view, as arrays
    load_run        what `padgs-run` left in a folder
    distortion_map  Omega at every pixel of a panorama

Each is imported when it is first used: `padgs.results` must load without torch, and `padgs --help` answer at once.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from padgs.data import load as load_scene
    from padgs.geometry.distortion import distortion_map
    from padgs.multirun.composition import make_method
    from padgs.runs.load import draw, load_run
    from padgs.training.options import Budget

# Threads that wait for the next parallel piece of work must sleep, not spin: on a machine with other work on it,
# spinning made training 20 times slower. Has to be said before torch loads its OpenMP runtime.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

_HOMES = {
    "load_scene": ("padgs.data", "load"),
    "make_method": ("padgs.multirun.composition", "make_method"),
    "Budget": ("padgs.training.options", "Budget"),
    "draw": ("padgs.runs.load", "draw"),
    "load_run": ("padgs.runs.load", "load_run"),
    "distortion_map": ("padgs.geometry.distortion", "distortion_map"),
}
__all__ = ["Budget", "distortion_map", "draw", "load_run", "load_scene", "make_method"]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return import_module("importlib.metadata").version("padgs")
    if name not in _HOMES:
        raise AttributeError(f"padgs has no {name!r}; it offers {', '.join(_HOMES)}, and packages as padgs.render")
    module, attribute = _HOMES[name]
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    return [*globals(), *_HOMES]
