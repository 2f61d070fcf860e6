"""The sizes and lengths of an EgoNeRF. The defaults are the published ones, except where it says ours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from padgs.checks import check, check_known

LENGTH_UNITS = ("scene", "world")


class Constants(NamedTuple):
    """What is published with other values indoors than outdoors."""

    density_shift: float  # density = softplus(feature + shift)
    distance_scale: float  # optical depth = density x scale x length
    near: float
    far: float
    first_radius: float  # of the radial nodes, and the shortest interval between nodes or between first samples
    environment: bool  # whether a picture of the sphere lies behind everything; else it is black

    def in_units_of(self, unit: float) -> Constants:
        """The same model, with lengths in units of `unit`."""
        near, far, first_radius = self.near / unit, self.far / unit, self.first_radius / unit
        return self._replace(distance_scale=self.distance_scale * unit, near=near, far=far, first_radius=first_radius)


# In world units, of Ricoh360 and of the rooms of OmniBlender; ours: how large the scene's unit of such scenes is.
PUBLISHED = {
    "outdoor": (Constants(-10.0, 25.0, 0.1, 300.0, 0.05, True), 5.0),
    "indoor": (Constants(-8.0, 25.0, 0.01, 15.0, 0.03, False), 2.5),
}


@dataclass(frozen=True)
class EgoNeRFOptions:
    """The model. All lengths are in `length_unit`; None: the published value for the surroundings."""

    radial_nodes: int = 150  # of each chart
    polar_nodes: int = 172  # ... in polar angle
    azimuth_nodes: int = 516  # ... in azimuth
    density_components: int = 16  # of each mode
    appearance_components: int = 48  # of each mode
    features: int = 27  # what the basis makes of the appearance
    hidden: int = 128  # width of the network's two hidden layers
    feature_frequencies: int = 2  # of the encoding of features, for the network
    direction_frequencies: int = 2  # ... of directions
    coarse_samples: int = 128  # of each ray
    fine_samples: int = 128  # ... and more where those found something
    min_weight: float = 0.0  # ours: samples that contribute less are not shaded, their share is black
    length_unit: str = "scene"  # ours: Scene.scale, so the world's units do not matter | world: as published
    surroundings: str = "auto"  # indoor | outdoor | auto: as the cloud says, see `surroundings.of_scene`
    density_shift: float | None = None  # density = softplus(feature + shift)
    distance_scale: float | None = None  # optical depth = density x scale x length
    near: float | None = None  # distance where rays begin
    far: float | None = None  # ... and end
    first_radius: float | None = None  # of the radial nodes, and the shortest interval between nodes or samples
    environment: bool | None = None  # whether a picture of the sphere lies behind everything; else it is black
    environment_height: int = 1920  # its rows; it has twice as many columns
    samples_at_once: int = 1 << 18  # ours: bounds the memory of a pass, in training and rendering

    def __post_init__(self) -> None:
        check_known(self, length_unit=LENGTH_UNITS, surroundings=("auto", *PUBLISHED))
        nodes = ("radial_nodes", "polar_nodes", "azimuth_nodes")
        check(self, "even, for the coarse grid halves it, and at least 4", lambda n: n >= 4 and n % 2 == 0, *nodes)
        sizes = ("density_components", "appearance_components", "features", "hidden", "environment_height")
        check(self, "at least 1", lambda size: size >= 1, *sizes)
        check(self, "at least 0", lambda count: count >= 0, "feature_frequencies", "direction_frequencies")
        if self.coarse_samples < 4 or self.fine_samples < 1:
            raise ValueError(
                f"coarse_samples is {self.coarse_samples} and fine_samples {self.fine_samples}; "
                "they must be at least 4 and 1"
            )
        for surroundings in PUBLISHED if self.surroundings == "auto" else (self.surroundings,):
            _refuse_impossible(self.constants(surroundings))
        check(self, "in [0, 1)", lambda weight: 0 <= weight < 1, "min_weight")
        if self.samples_at_once < self.samples:
            raise ValueError(
                f"samples_at_once is {self.samples_at_once}, less than the {self.samples} of a single ray; raise it"
            )

    def constants(self, surroundings: str) -> Constants:
        """The values that are used indoors or outdoors, those given before the published ones."""
        published, unit = PUBLISHED[surroundings]
        if self.length_unit == "scene":
            published = published.in_units_of(unit)
        given = {name: getattr(self, name) for name in Constants._fields}
        return published._replace(**{name: value for name, value in given.items() if value is not None})

    @property
    def samples(self) -> int:
        """Samples of a ray that are shaded."""
        return self.coarse_samples + self.fine_samples

    @property
    def rays_at_once(self) -> int:
        """Rays of a pass."""
        return self.samples_at_once // self.samples


def _refuse_impossible(constants: Constants) -> None:
    near, far, first_radius = constants.near, constants.far, constants.first_radius
    if not 0 < first_radius < far - near or not near > 0:
        raise ValueError(
            f"near is {near}, far {far} and first_radius {first_radius}; near and first_radius must be > 0, and "
            "far - near larger than first_radius"
        )
    check(constants, "> 0", lambda scale: scale > 0, "distance_scale")
