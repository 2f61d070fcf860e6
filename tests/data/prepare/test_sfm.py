"""Pairs to match, level worlds, and resources of the machine."""

import errno
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from padgs.data.capture import Cloud, Frame
from padgs.data.formats.colmap_lens import pycolmap_module
from padgs.data.prepare import work
from padgs.data.prepare.pairs import EXHAUSTIVE_UP_TO, image_pairs, similarities
from padgs.data.prepare.pipeline import level_world
from padgs.data.prepare.sfm import Group, _register

NAMES = [f"{index:04d}" for index in range(500)]


def ring(names: list[str]) -> np.ndarray:
    """Return similarities of places on a circle."""
    angle = 2 * np.pi * np.array([int(name) for name in names]) / len(names)
    return np.cos(angle[:, None] - angle)


def test_few_images_are_paired_exhaustively_and_many_sequentially_with_loop_closure():
    pairs = image_pairs(NAMES[:EXHAUSTIVE_UP_TO])
    assert len(pairs) == len(set(pairs)) == EXHAUSTIVE_UP_TO * (EXHAUSTIVE_UP_TO - 1) // 2
    assert image_pairs(NAMES[:200], "exhaustive")[-1] == ("0198", "0199")
    pairs = set(image_pairs(NAMES, "auto", ring))
    assert len(pairs) < 20 * len(NAMES)
    assert all(a < b for a, b in pairs)
    for step in (*range(1, 11), 16, 32, 64, 128, 256):
        assert ("0100", f"{100 + step:04d}") in pairs
    assert ("0100", "0111") not in pairs and ("0000", "0299") in image_pairs(NAMES[:300], "similar", ring)
    assert ("0000", "0499") in pairs  # a path that comes back to its start
    assert image_pairs(NAMES[::-1], "auto", ring) == image_pairs(NAMES, "auto", ring)


def test_panoramas_with_the_same_features_are_similar(tmp_path):
    pycolmap, random = pycolmap_module(), np.random.default_rng(0)
    sift, names = pycolmap.FeatureExtractorType.SIFT, [f"{k}.png" for k in range(6)]
    _register(tmp_path / "a.db", [Group(tuple(names), 64, 32)])
    places = random.integers(0, 256, (2, 80, 128))
    with pycolmap.Database.open(tmp_path / "a.db") as entries:
        for k, image in enumerate(entries.read_all_images()):
            seen = random.permutation(places[k % 2])[:50] + random.integers(-9, 10, (50, 128))
            found = np.clip(seen, 0, 255).astype(np.uint8)
            entries.write_descriptors(image.image_id, pycolmap.FeatureDescriptors(sift, found))
    alike = similarities(tmp_path / "a.db", [[name] for name in names], seed=0)
    assert alike[0, [2, 4]].min() > 2 * alike[0, [1, 3, 5]].max()


def test_names_are_sorted_naturally():
    pairs = image_pairs([f"pano{number}.jpg" for number in range(1, 121)], "sequential")
    assert ("pano9.jpg", "pano10.jpg") in pairs and ("pano10.jpg", "pano100.jpg") not in pairs


def test_worlds_are_levelled_by_the_smallest_rotation():
    cloud = Cloud(torch.eye(3, dtype=torch.float64), torch.zeros(3, 3, dtype=torch.uint8))
    for vector in ((0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (0.6, 0.0, 0.8), (-0.48, 0.64, -0.6)):
        pose = torch.eye(4, dtype=torch.float64)
        turn = Rotation.align_vectors([vector], [(0.0, -1.0, 0.0)])[0]
        pose[:3, :3] = torch.from_numpy(turn.as_matrix()).mT
        (frame,), levelled, _ = level_world((Frame("a", Path("a"), pose),), cloud)
        rotation = levelled.points.mT  # of the axes
        torch.testing.assert_close(-frame.cam_from_world[1, :3], torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
        torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3, dtype=torch.float64))
        assert (rotation.trace().item() - 1) / 2 == pytest.approx(vector[2], abs=1e-9)  # cosine of its angle


def test_threads_are_limited_by_free_memory(monkeypatch):
    assert work.free_memory() > 50_000_000
    monkeypatch.setattr(work, "cores", lambda: 12)
    free = {"bytes": 2_000_000_000}
    monkeypatch.setattr(work, "free_memory", lambda: free["bytes"])
    assert work.threads_for(2048, 1024) == work.threads_for(512, 256) == 3
    assert work.threads_for(4096, 2048) == work.threads_for(8192, 4096) == 1
    free["bytes"] = 12_000_000_000
    assert work.threads_for(8192, 4096) == 8 and work.threads_for(3200, 3200) == 4, "a side is limited, not the area"
    for free["bytes"] in (None, 64_000_000_000):
        assert work.threads_for(2048, 1024) == 8
    free["bytes"] = 1
    assert work.threads_for(2048, 1024) == 1


def test_a_working_folder_that_is_half_deleted_is_not_resumed(tmp_path, monkeypatch):
    folder = work.WorkFolder(tmp_path / "work")
    folder.open("images", "old")
    folder.run_once("features", lambda: None)
    (tmp_path / "work" / "views").mkdir()
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(work.shutil, "rmtree", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt))
        folder.open("images", "new")
    folder.open("images", "old")
    assert [path.name for path in (tmp_path / "work").iterdir()] == ["images.sha256"]


def test_files_are_copied_on_file_systems_without_links(tmp_path, monkeypatch):
    original = tmp_path / "original.png"
    original.write_bytes(b"a picture")
    link, copy = tmp_path / "link", tmp_path / "copy"

    def refuse(*args, **kwargs):
        raise PermissionError(errno.EPERM, "Operation not permitted")

    work.link_or_copy(original, link)
    monkeypatch.setattr(Path, "symlink_to", refuse)
    work.link_or_copy(link, copy)
    assert link.is_symlink() and not copy.is_symlink() and not copy.samefile(original)
    assert copy.read_bytes() == b"a picture"


def test_a_full_disk_is_refused(tmp_path, monkeypatch):
    work.refuse_full(tmp_path)
    monkeypatch.setattr(work, "MIN_FREE_DISK", 1 << 60)
    with pytest.raises(OSError, match="MiB is left on its disk: free some space") as refused:
        work.refuse_full(tmp_path)
    assert refused.value.errno == errno.ENOSPC
