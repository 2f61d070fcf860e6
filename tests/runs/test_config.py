"""What no run could do anything sensible with is found when its configuration is composed."""

from dataclasses import fields, is_dataclass
from typing import get_args, get_origin, get_type_hints

import pytest
from support.composed import configuration

from padgs.baselines import METHODS
from padgs.checks import ConfigError, lookup
from padgs.data.synthetic.options import SyntheticOptions
from padgs.multirun.composition import composing
from padgs.runs.config import DataConfig, Settings, config_from_values

MEANINGLESS = {
    "render.near=inf": "render.near is inf; it must be finite",
    "render.low_pass=inf": "it must be finite",
    "render.low_pass=nan": "render.low_pass is nan",
    "train.max_seconds=0": "max_seconds is 0.0; it must be > 0",
    "train.iterations=-5": "train.iterations is -5; it must be from 1 to 100000000",
    "budget.seconds=1e300": "budget.seconds is 1e+300; it must be from 0 to 100000000",
    "render.low_pass=1e30": "render.low_pass is 1e+30; it must be from 0 to 10000",
    "run.threads=100000": "run.threads is 100000; it must be from 1 to 1024",
    "method=padgs method.offset_rate=[1e30,1]": "method.offset_rate[0] is 1e+30; it must be from",
    "protocol.paper.metrics=[]": "metrics is (); it must be at least one of psnr",
    "run.checkpoint_seconds=nan": "it must be finite",
    "run.checkpoint_seconds=-1": "checkpoint_seconds is -1; it must be from 0",
    "seed=-1": "seed is -1; it must be from 0",
    "method.gradient_threshold=nan": "it must be finite",
    "method.gradient_threshold=-1": "gradient_threshold is -1.0",
    "method=omnigs method.gradient_threshold=-1": "gradient_threshold is -1.0",
    "method=omnigs method.percent_dense=-1": "percent_dense is -1.0",
    "method=omnigs method.min_opacity=2": "min_opacity is 2.0; it must be an opacity below 1",
}
TOO_LATE = {
    "render.projection=erpp": "unknown projection 'erpp'; known: erp, pinhole, tangent, ray",
    "method=padgs render.projection=pinhole": "or set cubemap=true",
    "render.backend=gpu": "unknown backend 'gpu'; known: auto, torch, cpu, cuda",
    "method=seam360gs render.projection=erp": "requires a Panorama camera, not a RayTable",
    "method=crops_3dgs render.projection=erp render.cubemap=false": "requires a Panorama camera, not a Pinhole",
    "method=cubemap_3dgs train.weight=solid_angle": "have no latitude; set uniform",
    "method=cubemap_3dgs train.poses=learned": "cut from one photograph would learn its own; leave it at given",
    "method=egonerf render.projection=ray": "egonerf casts rays",
    "method=spags render=default": "render=default is not for method=spags, which has own settings of render; leave it",
    "method=op43dgs render=released": "own settings of render; instead of it set render.near=0.2",
    "method=spags_tuned train=uniform": "own settings of train; instead of it set train.weight=uniform",
    "method=padgs_release train=default": "which has own settings of train; leave it out",
    "train=uniform": "train=uniform is not for method=padgs_plus",
    "render.projection=ray render.bounds=square render.wrap=false": "has no square bounds",
    "render.core_size=1000": "core_size is 1000; it must be from 1 to 256",
    "method=omnigs method.sh_degree=9": "sh_degree is 9; it must be 0 to 3",
    "method=padgs method.voxel_size=-1": "voxel_size is -1.0; it must be a length > 0",
    "method=padgs data.voxel_size=-1": "voxel_size is -1.0",
    "method=padgs method.offset_rate=[0,1]": "it must be two rates > 0",
    "method=padgs method.feature_rate=-1": "feature_rate is -1.0",
    "data.format=x": "unknown format 'x'; known: auto, colmap",
    "data.dataset=x": "unknown dataset 'x'; known: roam360",
    "+scene=synthetic_bare_room data.path=room": "+scene=synthetic_bare_room generates a scene, but data",
    "+scene=two_lenses data.path=room": "+scene=two_lenses generates a scene, but data.path=room names",
    "data.path=": "path is ; it must be null, or not empty",
    "run.folder=": "folder is ; it must be not empty",
    "smallest=true": "unknown smallest 'true'; known: off, on",
}
OF_ANOTHER_TYPE = {
    "protocol.paper=null": "protocol.paper is None; it must be a group of keys",
    "protocol.paper.lpips=3": "protocol.paper.lpips is 3; it must be a text",
    "data.generator=3": "data.generator is 3; it must be a group of keys",
    "data.generator.width=abc": "data.generator.width is 'abc'; it must be a whole number",
    "data.generator.width=9": "data.generator.width is 9; it must be an even number",
    "data.generator.x=1": "unknown key data.generator.x; known: data.generator.scene",
}


@pytest.fixture(scope="module", autouse=True)
def composed_once():
    with composing():
        yield


@pytest.mark.parametrize("line, message", [*MEANINGLESS.items(), *TOO_LATE.items(), *OF_ANOTHER_TYPE.items()])
def test_what_makes_no_sense_is_refused_at_composition(line, message):
    with pytest.raises(ConfigError) as refused:
        configuration(line.split())
    assert message in str(refused.value)


def numbers(options: object, where: str = ""):
    """Yield the dotted keys of the numeric fields of a dataclass."""
    hints = get_type_hints(type(options))
    for field in fields(options):
        if is_dataclass(value := getattr(options, field.name)):
            yield from numbers(value, f"{where}{field.name}.")
        elif {int, float} & {hints[field.name], *get_args(hints[field.name])}:
            pair = get_origin(hints[field.name]) is tuple
            yield f"{where}{field.name}" + "=[1e30,1]" * pair


@pytest.mark.parametrize("method", METHODS)
def test_every_number_has_limits(method):
    known = [*numbers(Settings()), *numbers(lookup(METHODS, method, "method").Options(), "method.")]
    known += numbers(SyntheticOptions(), "data.generator.")
    for key in known:
        values = {"method": {"name": method}, "protocol": {"paper": {}}}
        *groups, name = key.partition("=")[0].split(".")
        place = values
        for group in groups:
            place = place.setdefault(group, {})
        place[name] = [1e30, 1.0] if key.endswith("]") else 1e30
        with pytest.raises(ConfigError, match=f"{name}.* is 1e.30; it must be from .* to "):
            config_from_values(values)


def test_the_width_of_a_capture_is_not_that_of_a_generated_scene():
    assert DataConfig(path="x", format="auto", width=12288).options("cpu").width == 12288
    assert DataConfig(path="x", format="synthetic", width=64).synthetic.width == 64
    with pytest.raises(ValueError, match="are 2.3 billion pixels"):
        DataConfig(width=12288)
