"""The knobs of the synthetic scenes. A configuration determines every pixel, pose and point, and is the cache key."""

from __future__ import annotations

import math
from dataclasses import dataclass

from padgs.data.capture import DataError

SCENES = (
    *("room", "two_rooms", "outdoor", "pole_torture", "bare_room", "near_clutter", "glossy"),
    *("white_room", "checker_room", "enfilade"),
)
PATHS = ("roaming", "cross", "line")
HEADINGS = ("path", "fixed", "random")


@dataclass(frozen=True)
class SyntheticOptions:
    """What to generate. The defaults are the embedded scene of a run without arguments.

    Everything is built and drawn in metres; `world_scale` and `world_rotation` then move poses, points and depth, so
    the images do not depend on them. Pose noise, exposure and the two lenses touch training views only: test views are
    the truth.
    """

    scene: str = "room"  # a name of `padgs.data.synthetic.SCENES`
    width: int = 512  # pixels; the height is half of it
    train_views: int = 24  # along the path
    test_views: int = 6  # spread evenly between the training views along the path
    path: str | None = None  # roaming | cross | line; None = the scene's own
    reach: float | None = None  # metres from the middle of the path to its ends; None = the scene's own
    heading: str = "path"  # path = look along the path; fixed = along world x; random = any, per view
    yaw: float = 0.0  # degrees, added to every heading
    tilt: float = 0.0  # degrees, standard deviation of roll and of pitch per view
    samples: int = 16  # rays per pixel, a square number: stratified and jittered
    seed: int = 0  # of the path, the points and the noise
    texture_frequency: float = 1.0  # multiplies the spatial frequency of every pattern
    objects: int | None = None  # number of loose objects besides the furniture; None = the scene's own
    rooms: int | None = None  # of an enfilade, with `objects` each; None = 2
    spokes: int = 16  # of the Siemens stars in pole_torture
    nearest: float | None = None  # metres from the path to what hangs beside it in near_clutter; None = 0.05
    horizon: float | None = None  # metres to the mountains outdoors; None = 300
    points: int = 20_000  # of the cloud, on surfaces that a training view sees
    point_noise: float = 0.002  # standard deviation per axis, relative to the distance from the observing camera
    outliers: float = 0.01  # share of points that are nowhere near a surface
    pose_noise_translation: float = 0.0  # standard deviation per axis, relative to the scene's median depth
    pose_noise_rotation: float = 0.0  # degrees, standard deviation of the angle
    exposure: float = 0.0  # training views are brightened by a factor 2^e, e uniform in [-exposure, exposure]
    lens_gap: float = 0.0  # between the two lenses of the camera of training views, relative to the median depth
    lens_k1: float = 0.0  # theta' = theta (1 + k1 theta^2) of both lenses, see padgs/geometry/lens.py
    lens_blend: float = 5.0  # degrees on both sides of the plane between the lenses in which both are seen
    world_scale: float = 1.0  # world units per metre
    world_rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)  # degrees about world x, then y, then z

    def __post_init__(self) -> None:
        for field, known in (("scene", SCENES), ("path", (None, *PATHS)), ("heading", HEADINGS)):
            if getattr(self, field) not in known:
                names = ", ".join(sorted(name for name in known if name is not None))
                raise DataError(f"unknown synthetic {field} {getattr(self, field)!r}; known: {names}")
        if self.width < 8 or self.width % 2:
            raise DataError(f"width {self.width} is not an even number >= 8; a panorama is 2:1 (data.width)")
        if math.isqrt(max(self.samples, 0)) ** 2 != self.samples or self.samples < 1:
            raise DataError(f"samples {self.samples} is not a square number; use 1, 4, 9, 16, 25, ...")
        for field, least in (("train_views", 2), ("test_views", 0), ("points", 1), ("spokes", 1)):
            if getattr(self, field) < least:
                raise DataError(f"{field} {getattr(self, field)} is less than {least}")
        for field in ("point_noise", "pose_noise_translation", "pose_noise_rotation", "exposure", "tilt", "lens_gap"):
            if not 0 <= getattr(self, field) < math.inf:
                raise DataError(f"{field} {getattr(self, field)} is not a finite number >= 0")
        if not 0 <= self.lens_blend < 90:
            raise DataError(f"lens_blend {self.lens_blend} is not an angle in [0, 90) degrees")
        if not -0.1 <= self.lens_k1 <= 0.1:  # up to the horizon of a lens, theta' must grow with theta
            raise DataError(f"lens_k1 {self.lens_k1} is not in [-0.1, 0.1]")
        if not 0 <= self.outliers < 1:
            raise DataError(f"outliers {self.outliers} is not a share in [0, 1)")
        for field in ("texture_frequency", "world_scale"):
            if not 0 < getattr(self, field) < math.inf:
                raise DataError(f"{field} {getattr(self, field)} is not a finite number > 0")
        for field in ("reach", "nearest", "horizon"):
            length = getattr(self, field)
            if length is not None and not 0 < length < math.inf:
                raise DataError(f"{field} {length} is not a finite length > 0 in metres; use null for the scene's own")
        if self.objects is not None and self.objects < 0:
            raise DataError(f"objects {self.objects} is negative; use null for the scene's own number")
        if self.rooms is not None and (self.scene != "enfilade" or self.rooms < 1):
            raise DataError(
                f"rooms is {self.rooms} of scene {self.scene}; an enfilade has 1 or more, and others none to choose: "
                "set data.generator.scene=enfilade, or rooms to null"
            )

    @property
    def title(self) -> str:
        """What the scene is called. From a path of another length, with nearer or farther things, of other rooms, with
        noisy poses, or seen by two lenses, a room is another scene than the room.

        >>> SyntheticOptions(pose_noise_rotation=0.2).title, SyntheticOptions(reach=1.0, lens_gap=0.05).title
        ('synthetic-room-noisy-poses', 'synthetic-room-other-path-two-lenses')
        >>> SyntheticOptions("outdoor", horizon=3000).title
        'synthetic-outdoor-horizon-3000m'
        """
        words = ["synthetic", self.scene]
        if self.reach is not None:
            words.append("other-path")
        words += [
            f"{name}-{length:g}m" for name in ("nearest", "horizon") if (length := getattr(self, name)) is not None
        ]
        if self.rooms is not None:
            words.append(f"of-{self.rooms}")
        if self.pose_noise_translation or self.pose_noise_rotation:
            words.append("noisy-poses")
        if self.lens_gap or self.lens_k1:
            words.append("two-lenses")
        return "-".join(words)

    @property
    def height(self) -> int:
        """Image height in pixels."""
        return self.width // 2
