"""Options of the synthetic scenes. They determine every pixel, pose and point, and are the cache key."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from padgs.data.capture import DataError

SCENES = (
    *("room", "outdoor", "pole_torture", "bare_room", "near_clutter", "glossy"),
    *("white_room", "checker_room", "room_chain"),
)
PATHS = ("roaming", "cross", "line")
MAX_WIDTH, MAX_VIEWS, MAX_PIXELS = 16384, 10_000, 2_000_000_000
HEADINGS = ("path", "fixed", "random")

_WIDTHS = f"an even number from 8 to {MAX_WIDTH}, as a panorama is 2:1 (set data.width)"
_RULES: tuple[tuple[str, Callable[[Any], bool], str], ...] = (
    ("width", lambda x: 8 <= x <= MAX_WIDTH and x % 2 == 0, _WIDTHS),
    ("samples", lambda x: 1 <= x <= 1024 and math.isqrt(x) ** 2 == x, "a square number: 1, 4, 9, 16, 25, ... 1024"),
    ("train_views", lambda x: 2 <= x <= MAX_VIEWS, f"at least 2 and at most {MAX_VIEWS}"),
    ("test_views", lambda x: 0 <= x <= MAX_VIEWS, f"at least 0 and at most {MAX_VIEWS}"),
    ("points", lambda x: 1 <= x <= 10**8, "at least 1 and at most 100 million"),
    ("spokes", lambda x: x >= 1, "at least 1"),
    ("rooms", lambda x: x is None or x >= 1, "at least 1, or null for the default"),
    ("point_noise tilt lens_gap", lambda x: 0 <= x < math.inf, "a finite number >= 0"),
    ("pose_noise_translation pose_noise_rotation", lambda x: 0 <= x < math.inf, "a finite number >= 0"),
    ("texture_frequency world_scale", lambda x: 0 < x < math.inf, "a finite number > 0"),
    ("lens_blend", lambda x: 0 <= x < 90, "an angle in [0, 90) degrees"),
    ("lens_k1", lambda x: -0.1 <= x <= 0.1, "in [-0.1, 0.1]"),  # theta' must increase with theta up to 90 degrees
    ("outliers", lambda x: 0 <= x < 1, "a share in [0, 1)"),
    ("path_radius nearest horizon", lambda x: x is None or 0 < x < math.inf, "a finite length > 0 in metres, or null"),
    ("objects", lambda x: x is None or x >= 0, "at least 0, or null for the default"),
)
_OF_ONE_SCENE = {"rooms": "room_chain", "nearest": "near_clutter", "horizon": "outdoor", "spokes": "pole_torture"}


@dataclass(frozen=True)
class SyntheticOptions:
    """Options of a synthetic scene. The defaults are the scene of a run without arguments.

    Worlds are built and rendered in metres; `world_scale` is then applied to poses, points and depth, so that images do
    not depend on it. Pose noise, the two lenses and the figure affect training views only.
    """

    scene: str = "room"  # room | outdoor | glossy | ...: those of +scene=synthetic_NAME
    width: int = 512  # pixels; the height is half of it
    train_views: int = 24  # number, along the path
    test_views: int = 6  # spread evenly between the training views along the path
    path: str | None = None  # roaming | cross | line; None = default of the scene
    path_radius: float | None = None  # metres from the middle of the path to its ends; None = default of the scene
    heading: str = "path"  # path = look along the path; fixed = along world x; random = random per view
    tilt: float = 0.0  # degrees, standard deviation of roll and of pitch per view
    samples: int = 16  # rays per pixel, a square number; stratified and jittered
    seed: int = 0  # random seed of path, points and noise
    texture_frequency: float = 1.0  # factor on the spatial frequency of all patterns
    objects: int | None = None  # number of loose objects besides the furniture; None = default of the scene
    rooms: int | None = None  # number of rooms of room_chain, with `objects` in each; None = 2
    spokes: int = 16  # number of spokes of the Siemens stars in pole_torture
    nearest: float | None = None  # metres between the path and the objects beside it in near_clutter; None = 0.05
    horizon: float | None = None  # metres to the mountains of outdoor; None = 300
    points: int = 20_000  # number of points, on surfaces that training views see
    point_noise: float = 0.002  # standard deviation per axis, relative to the distance from the observing camera
    outliers: float = 0.01  # share of random points that lie on no surface
    pose_noise_translation: float = 0.0  # standard deviation per axis, relative to the scene's median depth
    pose_noise_rotation: float = 0.0  # degrees, standard deviation of the angle
    lens_gap: float = 0.0  # distance of the two lenses of training views, relative to the median depth
    lens_k1: float = 0.0  # distortion of both lenses: theta' = theta (1 + k1 theta^2), see padgs/geometry/lens.py
    lens_blend: float = 5.0  # degrees on both sides of the plane between the lenses in which both are blended
    world_scale: float = 1.0  # world units per metre
    figure: bool = False  # a person walks through the scene: at another place in each training view, in no test view

    def __post_init__(self) -> None:
        for field, known in (("scene", SCENES), ("path", (None, *PATHS)), ("heading", HEADINGS)):
            if getattr(self, field) not in known:
                names = ", ".join(sorted(name for name in known if name is not None))
                raise DataError(f"unknown synthetic {field} {getattr(self, field)!r}; known: {names}")
        for names, is_valid, rule in _RULES:
            for name in names.split():
                if not is_valid(value := getattr(self, name)):
                    raise DataError(f"data.generator.{name} is {value}; it must be {rule}")
        views = self.train_views + self.test_views
        if (pixels := views * self.width * self.height) > MAX_PIXELS:
            raise DataError(
                f"{views} views of {self.width}x{self.height} are {pixels / 1e9:.1f} billion pixels, and at most "
                f"{MAX_PIXELS / 1e9:g} are generated; lower data.width, data.generator.train_views or test_views"
            )
        for name, scene in _OF_ONE_SCENE.items():
            if (value := getattr(self, name)) != getattr(type(self), name) and self.scene != scene:
                remedy = f"set data.generator.scene={scene}, or leave it out"
                raise DataError(f"data.generator.{name} is {value}, and only {scene} has this option: {remedy}")

    @property
    def title(self) -> str:
        """Name of the scene, with a suffix for every option that makes it a different scene.

        >>> SyntheticOptions(pose_noise_rotation=0.2).title, SyntheticOptions(path_radius=1.0, lens_gap=0.05).title
        ('synthetic-room-noisy-poses', 'synthetic-room-other-path-two-lenses')
        >>> SyntheticOptions("outdoor", horizon=3000).title
        'synthetic-outdoor-horizon-3000m'
        """
        words = {
            "other-path": self.path_radius is not None,
            f"nearest-{self.nearest or 0:g}m": self.nearest is not None,
            f"horizon-{self.horizon or 0:g}m": self.horizon is not None,
            f"of-{self.rooms}": self.rooms is not None,
            "noisy-poses": self.pose_noise_translation or self.pose_noise_rotation,
            "two-lenses": self.lens_gap or self.lens_k1,
            "figure": self.figure,
        }
        return "-".join(["synthetic", self.scene, *(word for word, applies in words.items() if applies)])

    @property
    def height(self) -> int:
        """Image height in pixels."""
        return self.width // 2
