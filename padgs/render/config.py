"""The `render` group of the configuration: the renderer's options, before the scene is known."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from padgs.checks import check_known
from padgs.render import BACKENDS
from padgs.render.contract import LOW_PASS_KINDS, RenderOptions

NEAR_UNITS = ("scene", "world")


@dataclass(frozen=True)
class RenderConfig(RenderOptions):
    """As `RenderOptions`, but that lengths are relative to the scene; refuses what those refuse."""

    near: float = 0.01  # in `near_unit`
    near_unit: str = "scene"  # scene: multiples of Scene.scale; world: as the published code does
    backend: str = "auto"  # a name of `padgs.render.BACKENDS`, or auto

    def __post_init__(self) -> None:
        check_known(self, projection=LOW_PASS_KINDS, near_unit=NEAR_UNITS, backend=("auto", *BACKENDS))
        super().__post_init__()

    def options(self, scene_unit: float) -> RenderOptions:
        """Renderer options for a scene whose own unit of length is `scene_unit` world units."""
        values: dict[str, Any] = {field.name: getattr(self, field.name) for field in fields(RenderOptions)}
        if self.near_unit == "scene":
            values["near"] *= scene_unit
        return RenderOptions(**values)
