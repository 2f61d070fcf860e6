"""Options of EgoNeRF: model and training. Defaults are the published values unless marked as ours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from padgs.checks import check, check_known

LENGTH_UNITS = ("scene", "world")


class Constants(NamedTuple):
    """Constants whose published values differ between indoor and outdoor scenes."""

    density_shift: float  # density = softplus(feature + shift)
    distance_scale: float  # optical depth = density x scale x length
    near: float
    far: float
    first_radius: float  # of the radial nodes, and the shortest interval between nodes or coarse samples
    environment: bool  # environment map as background; else black

    def in_units_of(self, unit: float) -> Constants:
        """Return the constants with lengths in units of `unit`."""
        near, far, first_radius = self.near / unit, self.far / unit, self.first_radius / unit
        return self._replace(distance_scale=self.distance_scale * unit, near=near, far=far, first_radius=first_radius)


# World units of Ricoh360 and of the rooms of OmniBlender; ours: the scene scale of such scenes.
PUBLISHED = {
    "outdoor": (Constants(-10.0, 25.0, 0.1, 300.0, 0.05, True), 5.0),
    "indoor": (Constants(-8.0, 25.0, 0.01, 15.0, 0.03, False), 2.5),
}


@dataclass(frozen=True)
class EgoNeRFOptions:
    """The model, and its training as published for Ricoh360.

    Lengths are in `length_unit`; None: the published value for the surroundings.
    """

    radial_nodes: int = 150  # of each chart
    polar_nodes: int = 172  # of each chart
    azimuth_nodes: int = 516  # of each chart
    density_components: int = 16  # of each mode
    appearance_components: int = 48  # of each mode
    features: int = 27  # appearance features of the basis
    hidden: int = 128  # width of the two hidden layers
    feature_frequencies: int = 2  # of the positional encoding of features
    direction_frequencies: int = 2  # of the positional encoding of directions
    coarse_samples: int = 128  # of each ray
    fine_samples: int = 128  # importance samples of each ray
    min_weight: float = 0.0  # ours: samples with smaller weights are not shaded but black
    length_unit: str = "scene"  # ours: `Scene.scale`, independent of world units | world: as published
    surroundings: str = "auto"  # indoor | outdoor | auto: by the cloud, see `surroundings_of`
    density_shift: float | None = None  # density = softplus(feature + shift)
    distance_scale: float | None = None  # optical depth = density x scale x length
    near: float | None = None  # distance of the first sample
    far: float | None = None  # distance of the last sample
    first_radius: float | None = None  # of the radial nodes, and the shortest interval between nodes or samples
    environment: bool | None = None  # environment map as background; else black
    environment_height: int = 1920  # rows of the environment map; twice as many columns
    samples_at_once: int = 1 << 18  # ours: bounds the memory of a pass, in training and rendering
    rays: int = 4096  # of an iteration
    grid_rate: float = 0.02  # learning rates of Adam at the start
    network_rate: float = 1e-3  # bases and network
    environment_rate: float = 5e-3  # of the environment map
    rate_decay: float = 0.1  # rates and weights of the total variation decay exponentially to this share
    density_variation: float = 0.1  # weight of the total variation of the density planes; 0: none
    appearance_variation: float = 0.01  # weight of the total variation of the appearance planes

    def __post_init__(self) -> None:
        check_known(self, length_unit=LENGTH_UNITS, surroundings=("auto", *PUBLISHED))
        nodes = ("radial_nodes", "polar_nodes", "azimuth_nodes")
        check(self, "even, for the coarse grid halves it, and at least 4", lambda n: n >= 4 and n % 2 == 0, *nodes)
        sizes = ("density_components", "appearance_components", "features", "hidden", "environment_height", "rays")
        check(self, "at least 1", lambda size: size >= 1, *sizes)
        check(self, "at least 0", lambda count: count >= 0, "feature_frequencies", "direction_frequencies")
        if self.coarse_samples < 4 or self.fine_samples < 1:
            raise ValueError(
                f"coarse_samples is {self.coarse_samples} and fine_samples {self.fine_samples}; "
                "they must be at least 4 and 1"
            )
        rates = ("grid_rate", "network_rate", "environment_rate", "rate_decay")
        check(self, "> 0", lambda rate: rate > 0, *rates)
        check(self, ">= 0", lambda weight: weight >= 0, "density_variation", "appearance_variation")
        for surroundings in PUBLISHED if self.surroundings == "auto" else (self.surroundings,):
            _check_constants(self.constants(surroundings))
        check(self, "in [0, 1)", lambda weight: 0 <= weight < 1, "min_weight")
        if self.samples_at_once < self.samples:
            raise ValueError(
                f"samples_at_once is {self.samples_at_once}, less than the {self.samples} of a single ray; raise it"
            )

    def constants(self, surroundings: str) -> Constants:
        """Return the constants for indoor or outdoor; given values replace published ones."""
        published, unit = PUBLISHED[surroundings]
        if self.length_unit == "scene":
            published = published.in_units_of(unit)
        given = {name: getattr(self, name) for name in Constants._fields}
        return published._replace(**{name: value for name, value in given.items() if value is not None})

    @property
    def samples(self) -> int:
        """Shaded samples of a ray."""
        return self.coarse_samples + self.fine_samples

    @property
    def rays_at_once(self) -> int:
        """Rays in one pass."""
        return self.samples_at_once // self.samples


def _check_constants(constants: Constants) -> None:
    near, far, first_radius = constants.near, constants.far, constants.first_radius
    if not 0 < first_radius < far - near or not near > 0:
        raise ValueError(
            f"near is {near}, far {far} and first_radius {first_radius}; near and first_radius must be > 0, and "
            "far - near larger than first_radius"
        )
    check(constants, "> 0", lambda scale: scale > 0, "distance_scale")
