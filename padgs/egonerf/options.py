"""The sizes and lengths of an EgoNeRF. The defaults are the published ones (Ricoh360), except where it says ours."""

from __future__ import annotations

from dataclasses import dataclass

from padgs.checks import check, check_known

LENGTH_UNITS = ("scene", "world")


@dataclass(frozen=True)
class EgoNeRFOptions:
    """The model. All lengths are in `length_unit`."""

    radial_nodes: int = 150  # of each chart
    polar_nodes: int = 172
    azimuth_nodes: int = 516
    density_components: int = 16  # of each mode
    appearance_components: int = 48
    features: int = 27  # what the basis makes of the appearance
    hidden: int = 128  # width of the network's two hidden layers
    feature_frequencies: int = 2
    direction_frequencies: int = 2
    density_shift: float = -10.0  # density = softplus(feature + shift)
    distance_scale: float = 125.0  # optical depth = density x scale x length; ours, see the lengths
    coarse_samples: int = 128  # of each ray
    fine_samples: int = 128
    min_weight: float = 0.0  # ours: samples that contribute less are not shaded, their share is black
    length_unit: str = "scene"  # ours: Scene.unit, so the world's units do not matter | world: as published
    # Ours: published 0.1, 300 and 0.05 world units, here divided by 5, and distance_scale 25, here times 5.
    near: float = 0.02
    far: float = 60.0
    first_radius: float = 0.01  # of the radial nodes, and the shortest interval between nodes or between first samples
    environment: bool = True  # whether a picture of the sphere lies behind everything; else it is black
    environment_height: int = 1920  # its rows; it has twice as many columns
    samples_at_once: int = 1 << 18  # ours: bounds the memory of a pass, in training and rendering

    def __post_init__(self) -> None:
        check_known(self, length_unit=LENGTH_UNITS)
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
        if not 0 < self.first_radius < self.far - self.near or not self.near > 0:
            raise ValueError(
                f"near is {self.near}, far {self.far} and first_radius {self.first_radius}; near and first_radius must "
                "be > 0, and far - near larger than first_radius"
            )
        check(self, "> 0", lambda scale: scale > 0, "distance_scale")
        check(self, "in [0, 1)", lambda weight: 0 <= weight < 1, "min_weight")
        if self.samples_at_once < self.samples:
            raise ValueError(
                f"samples_at_once is {self.samples_at_once}, less than the {self.samples} of a single ray; raise it"
            )

    @property
    def samples(self) -> int:
        """Samples of a ray that are shaded."""
        return self.coarse_samples + self.fine_samples

    @property
    def rays_at_once(self) -> int:
        """Rays of a pass."""
        return self.samples_at_once // self.samples
