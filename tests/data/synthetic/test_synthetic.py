"""Built-in scenes: determinism, cache, and the property of each scene."""

import os

import numpy as np
import pytest
import torch
from PIL import Image

from padgs.data import DataError, DataOptions
from padgs.data.synthetic import (
    SCENES,
    SyntheticOptions,
    SyntheticTruth,
    cache_folder,
    camera,
    generate,
    load,
    read_cache,
)
from padgs.data.synthetic.paths import curve
from padgs.data.synthetic.scenes import descriptions, walk

TINY = {"scene": "bare_room", "width": 64, "train_views": 4, "test_views": 2, "points": 300, "samples": 4}


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("PADGS_CACHE", str(tmp_path / "cache"))


def same(first, second):
    assert first.fingerprint == second.fingerprint
    assert torch.equal(first.points, second.points)
    assert torch.equal(first.point_colors, second.point_colors)
    for a, b in zip((*first.train, *first.test), (*second.train, *second.test), strict=True):
        assert a.name == b.name
        assert torch.equal(a.cam_from_world, b.cam_from_world)
        assert torch.equal(a.load_pixels(), b.load_pixels())


@pytest.mark.parametrize("name", SCENES)
def test_every_scene_generates(name):
    scene = generate(SyntheticOptions(**(TINY | {"scene": name})))
    assert (len(scene.train), len(scene.test), scene.name) == (4, 2, f"synthetic-{name}")
    for view in (*scene.train, *scene.test):
        pixels = view.load_pixels()
        assert (pixels.shape, pixels.dtype) == ((32, 64, 3), torch.uint8)
        assert pixels.float().std() > 10
    assert scene.points.shape == (300, 3)
    assert scene.points.isfinite().all()
    assert scene.notes == ()


@pytest.mark.parametrize(
    "given", [{"points": "random"}, {"mask": "rows:5/6"}, {"split": "all"}, {"test_every": 4}, {"depth": "none"}]
)
def test_settings_of_captures_are_refused(given):
    ((name, value),) = given.items()
    with pytest.raises(DataError, match=f"data.{name}={value} changes nothing in a generated scene; leave it out"):
        load("", DataOptions(**given))


def test_cache_gives_identical_scenes(tmp_path):
    options = SyntheticOptions(**TINY)
    first = generate(options)
    files = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()}
    assert len(files) == 8  # six images, a table and a digest
    same(first, generate(options))
    assert {path: path.stat().st_mtime_ns for path in files} == files
    os.environ["PADGS_CACHE"] = str(tmp_path / "elsewhere")  # restored by the fixture
    same(first, generate(options))  # drawn again


def test_a_damaged_or_changed_cache_is_regenerated(tmp_path):
    def table():
        return next(tmp_path.rglob("scene.npz"))

    def invert():
        pixels = first.train[1].load_pixels().numpy()
        Image.fromarray(255 - pixels).save(next(tmp_path.rglob("000002.png")))

    def move_points():
        np.savez_compressed(table(), **(dict(np.load(table())) | {"points": np.zeros((300, 3))}))

    first = generate(options := SyntheticOptions(**TINY))
    for damage in (
        lambda: table().write_bytes(table().read_bytes()[:100]),
        lambda: next(tmp_path.rglob("000003.png")).unlink(),
        invert,
        move_points,
        lambda: table().with_name("sha256").unlink(),
    ):
        damage()
        assert read_cache(options) is None
        same(first, generate(options))
    assert read_cache(options) is not None


def test_scenes_generate_without_a_writable_cache(tmp_path, monkeypatch):
    expected = generate(SyntheticOptions(**TINY))
    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setenv("PADGS_CACHE", str(tmp_path / "file"))
    scene = generate(SyntheticOptions(**TINY))
    assert len(scene.notes) == 1
    assert "not cached" in scene.notes[0]
    same(scene, expected)


def test_options_and_seeds_change_the_key_and_the_scene():
    base, points = SyntheticOptions(**TINY), SyntheticOptions(**(TINY | {"points": 301}))
    seed = SyntheticOptions(**TINY, seed=1)
    assert len({cache_folder(options) for options in (base, SyntheticOptions(**TINY), points, seed)}) == 3
    first, second = generate(base), generate(seed)
    assert first.fingerprint != second.fingerprint
    assert not torch.equal(first.train[0].cam_from_world, second.train[0].cam_from_world)


def test_load_uses_the_data_options():
    scene = load("outdoor", DataOptions(width=32, generator={"train_views": 3, "test_views": 1, "points": 100}))
    assert scene.name == "synthetic-outdoor"
    assert (len(scene.train), scene.train[0].width, scene.train[0].height) == (3, 32, 16)
    with pytest.raises(DataError, match=r"unknown key data.generator.wdith; known: .*width.*train_views"):
        load("room", DataOptions(generator={"wdith": 3}))
    with pytest.raises(DataError, match="unknown synthetic scene 'rom'; known: bare_room, .*room"):
        load("rom", DataOptions())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"width": 15}, "even number"),
        ({"width": 10**9}, "width is 1000000000; it must be an even number from 8 to 16384"),
        ({"train_views": 10**9}, "train_views is 1000000000; it must be .* at most 10000"),
        ({"width": 8192, "train_views": 500}, "506 views of 8192x4096 are 17.0 billion pixels, and at most 2 are"),
        ({"points": 10**12}, "points is 1000000000000; it must be .* at most 100 million"),
        ({"samples": 5}, "square number"),
        ({"train_views": 1}, "train_views is 1; it must be at least 2"),
        ({"outliers": 1.0}, "share"),
        ({"world_scale": 0.0}, "world_scale is 0.0"),
        ({"point_noise": float("nan")}, "finite"),
        ({"path_radius": 0.0}, "path_radius is 0.0; it must be a finite length"),
        ({"horizon": float("inf")}, "horizon is inf; it must be a finite length"),
        ({"lens_gap": -0.1}, "lens_gap"),
        ({"lens_blend": 90.0}, "lens_blend"),
        ({"lens_k1": 0.5}, "lens_k1"),
        ({"path": "zigzag"}, "known: cross, line, roaming"),
        ({"objects": 2000}, "no free position"),
    ],
)
def test_invalid_options_are_refused(settings, message):
    with pytest.raises(DataError, match=message):
        SyntheticTruth(SyntheticOptions(**settings))


INTEGERS = ("width", "train_views", "test_views", "samples", "points", "seed", "objects", "rooms", "spokes")


@pytest.mark.parametrize("name", INTEGERS)
@pytest.mark.parametrize("value", [8.5, "many", True, [1], 10**9, -(10**12)])
def test_values_of_other_types_or_beyond_the_limits_are_refused(name, value):
    """An integer written as a float is one."""
    if not (name == "seed" and value == 10**9):
        with pytest.raises(DataError, match=f"data.generator.{name} is"):
            load("room_chain", DataOptions(generator={name: value}))


def depths(name, width=128, **settings):
    truth = SyntheticTruth(SyntheticOptions(scene=name, **settings))
    return truth, [camera.trace(truth.world, pose, width) for pose in truth.poses]


def test_outdoor_spans_three_orders_of_magnitude_and_has_sky():
    _, views = depths("outdoor")
    finite = np.concatenate([depth[np.isfinite(depth)] for depth, _ in views])
    near = np.quantile(finite, 1e-4)
    assert near < 0.8
    assert finite.max() > 290
    assert finite.max() / finite.min() > 500
    assert 0.2 < np.mean([(object_id == -1).mean() for _, object_id in views]) < 0.6


@pytest.mark.parametrize("horizon", [30, 3000])
def test_mountains_are_at_the_given_distance(horizon):
    _, views = depths("outdoor", 64, horizon=horizon, train_views=2, test_views=0)
    farthest = max(depth[np.isfinite(depth)].max() for depth, _ in views)
    assert 0.85 * horizon < farthest < 1.25 * horizon


@pytest.mark.parametrize("rooms", [2, 5])
def test_rooms_occlude_each_other(rooms):
    truth = SyntheticTruth(SyntheticOptions("room_chain", train_views=8 * rooms, test_views=0, rooms=rooms))
    rng = np.random.default_rng(0)
    middles = 5.0 * (np.arange(rooms) - (rooms - 1) / 2)
    cameras = np.stack([camera.center(pose) for pose in truth.poses])
    for middle in middles:
        points = rng.uniform((middle - 2.2, -2.2, 0.1), (middle + 2.2, 2.2, 2.7), (300, 3)).T
        seen = []
        for center in cameras:
            toward = points - center[:, None]
            far = np.linalg.norm(toward, axis=0)
            seen.append((truth.world.nearest(center[:, None], toward / far)[0] > far).mean())
        away = np.abs(cameras[:, 0] - middle)
        inside, outside = np.array(seen)[away < 1.5], np.array(seen)[away > 3.5]
        assert len(inside) >= 4 and inside.mean() > 0.8
        assert outside.mean() < 0.3


@pytest.mark.parametrize("rooms", [1, 2, 5])
@pytest.mark.parametrize("path", ["roaming", "cross", "line"])
def test_cameras_of_a_room_chain_keep_away_from_walls(rooms, path):
    _, views = depths("room_chain", 64, rooms=rooms, path=path, train_views=6 * rooms, test_views=0)
    assert min(depth.min() for depth, _ in views) > 0.25


@pytest.mark.parametrize(
    ("scene", "options"),
    [
        ("room_chain", {"rooms": 3}),
        ("near_clutter", {"nearest": 0.1}),
        ("outdoor", {"horizon": 800.0}),
        ("pole_torture", {"spokes": 4}),
    ],
)
def test_options_of_one_scene_are_refused_in_others(scene, options):
    assert SyntheticOptions(scene, **options)
    with pytest.raises(DataError, match=f"only {scene} has this option: set data.generator.scene={scene}"):
        SyntheticOptions("room", **options)


def test_a_chain_has_at_least_one_room():
    assert SyntheticOptions("room_chain", rooms=3).title == "synthetic-room_chain-of-3"
    with pytest.raises(DataError, match="rooms is 0; it must be at least 1"):
        SyntheticOptions("room_chain", rooms=0)


def test_pole_torture_has_rods_above_and_below_the_cameras():
    truth, views = depths("pole_torture")
    thin = [depth[[0, -1]].min(axis=1) for depth, _ in views]
    assert np.mean([rows[0] < 1.2 for rows in thin]) > 0.4  # the ceiling is 1.4 m above
    assert np.mean([rows[1] < 1.1 for rows in thin]) > 0.4


def test_posters_cover_a_tenth_of_the_bare_walls():
    truth = SyntheticTruth(SyntheticOptions(scene="bare_room", objects=0))
    room = truth.world.shapes[0]
    area = covered = 0.0
    for face in range(4):
        width, height = room.size(face)
        u, v = np.meshgrid(np.linspace(-width / 2, width / 2, 600), np.linspace(-height / 2, height / 2, 300))
        color = room.materials[face].texture(np.stack((u.ravel(), v.ravel())).astype(np.float32))
        covered += width * height * (np.abs(color - np.array([[0.8], [0.8], [0.78]])) > 0.02).any(0).mean()
        area += width * height
    assert covered / area == pytest.approx(0.10, abs=0.02)


@pytest.mark.parametrize("layer", [None, 0.02, 0.4])
def test_near_clutter_is_in_a_layer_of_25_cm_beside_the_path(layer):
    options, begins = SyntheticOptions(scene="near_clutter", nearest=layer), layer or 0.05
    truth, description = SyntheticTruth(options), descriptions()["scenes"]["near_clutter"]
    path = curve(walk(options), description["path"], truth.random("path"))
    near = truth.world.shapes[-description["objects"] :]
    for shape in near:
        center, radius = shape.bounds
        gap = np.linalg.norm(path - center, axis=1).min() - radius
        assert begins - 0.06 < gap < begins + 0.25  # bounding spheres: those of bars reach farther than the bars
    nearest = min(camera.trace(truth.world, pose, 128)[0].min() for pose in truth.poses)
    assert 0.8 * begins < nearest < begins + 0.15


@pytest.mark.parametrize(("name", "changes"), [("glossy", True), ("room", False)])
def test_only_glossy_surfaces_depend_on_the_view(name, changes):
    """Compare points of the floor from two cameras."""
    truth = SyntheticTruth(SyntheticOptions(scene=name))
    rng = np.random.default_rng(3)
    points = np.stack((rng.uniform(-1.2, 1.2, 400), rng.uniform(-1.2, 1.2, 400), np.zeros(400)))
    colors = []
    for pose in (truth.poses[0], truth.poses[15]):
        origin = camera.center(pose)[:, None]
        far = np.linalg.norm(points - origin, axis=0)
        colors.append(truth.world.color(origin.astype(np.float32), ((points - origin) / far).astype(np.float32)))
    assert (np.median(np.abs(colors[0] - colors[1])) > 0.01) == changes
