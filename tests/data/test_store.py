"""Area filter and cache of decoded images."""

import os
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from padgs.data import store as store_module
from padgs.data.capture import DataError
from padgs.data.images import decode
from padgs.data.store import ImageStore, StoredImage, area_resize

BYTES = 32 * 16 * 3


@pytest.fixture
def files(tmp_path: Path) -> list[Path]:
    source = np.random.default_rng(0)
    paths = [tmp_path / f"{i}.png" for i in range(6)]
    for path in paths:
        Image.fromarray(source.integers(0, 256, (32, 64, 3), dtype=np.uint8)).save(path)
    return paths


def _expected(path: Path) -> torch.Tensor:
    with Image.open(path) as image:
        return torch.from_numpy(area_resize(np.array(image), 32, 16))


def test_the_least_recently_used_image_is_evicted(files: list[Path]) -> None:
    store = ImageStore(limit_bytes=2 * BYTES, threads=0)
    images = [StoredImage(path, 32, 16, store) for path in files]
    for i in (0, 1, 0, 2, 0, 1):  # 1 goes when 2 comes, 2 goes when 1 comes back
        assert torch.equal(images[i](), _expected(files[i]))
        assert store.bytes <= 2 * BYTES
    assert store.decoded == 4


def test_a_limit_of_zero_disables_the_cache(files: list[Path]) -> None:
    store = ImageStore(limit_bytes=0, threads=0)
    image = StoredImage(files[0], 32, 16, store)
    assert torch.equal(image(), image())
    assert store.decoded == 2 and store.bytes == 0


def test_images_are_decoded_once_where_the_disk_keeps_them(files: list[Path], tmp_path: Path, monkeypatch) -> None:
    folder = tmp_path / "cache"
    folder.mkdir()
    first, later = (ImageStore(limit_bytes=0, folder=folder) for _ in range(2))
    for path in files:
        assert torch.equal(StoredImage(path, 32, 16, first)(), _expected(path))
    assert sorted(file.stat().st_size for file in folder.iterdir()) == [BYTES] * 6
    os.utime(files[0], (1, 1))  # it was written anew
    StoredImage(files[1], 32, 16, first).file(folder)[0].write_bytes(b"cut")
    decoded = []
    monkeypatch.setattr(store_module, "decode", lambda path, *how: decoded.append(path) or decode(path, *how))
    for path in files:
        assert torch.equal(StoredImage(path, 32, 16, later)(), _expected(path))
    assert decoded == files[:2]


@pytest.mark.parametrize("threads", [0, 1, 3])
def test_prefetching_does_not_change_values(threads: int, files: list[Path]) -> None:
    store = ImageStore(limit_bytes=3 * BYTES, threads=threads)
    images = [StoredImage(path, 32, 16, store) for path in files]
    order = torch.randint(0, 6, (60,), generator=torch.Generator().manual_seed(1)).tolist()
    for now, ahead in zip(order, [*order[1:], 0], strict=True):
        images[ahead].prefetch()
        assert torch.equal(images[now](), _expected(files[now]))
        assert store.bytes <= 3 * BYTES


def test_many_threads_decode_an_image_once(files: list[Path]) -> None:
    store = ImageStore(threads=2)
    image = StoredImage(files[0], 32, 16, store)
    barrier = threading.Barrier(8)

    def ask() -> torch.Tensor:
        barrier.wait()
        return image()

    with ThreadPoolExecutor(8) as pool:
        results = [future.result() for future in [pool.submit(ask) for _ in range(8)]]
    assert store.decoded == 1
    assert all(result is results[0] for result in results)


def test_errors_while_prefetching_are_raised_on_access(files: list[Path]) -> None:
    store = ImageStore(threads=1)
    files[0].write_bytes(files[0].read_bytes()[:300])
    image = StoredImage(files[0], 32, 16, store)
    image.prefetch()
    for _ in range(2):  # and again, not once only
        with pytest.raises(DataError, match="0.png is cut short"):
            image()


def test_an_output_pixel_is_the_mean_of_its_area() -> None:
    image = np.array([[[0], [100], [200]]], np.uint8)
    # Each of two pixels covers 1.5 input pixels: (0 + 100 / 2) / 1.5 and (100 / 2 + 200) / 1.5.
    assert area_resize(image, 2, 1)[0, :, 0].tolist() == [33, 167]


@pytest.mark.parametrize(("width", "height"), [(61, 31), (96, 48), (2, 1), (1, 1), (192, 96)])
def test_against_the_integral_image(width: int, height: int) -> None:
    image = np.random.default_rng(0).integers(0, 256, (96, 192, 3), dtype=np.uint8)
    whole = np.zeros((97, 193, 3))
    whole[1:, 1:] = image.astype(float).cumsum(0).cumsum(1)
    rows, columns = np.linspace(0, 96, height + 1), np.linspace(0, 192, width + 1)
    top, left = np.floor(rows).astype(int).clip(0, 95), np.floor(columns).astype(int).clip(0, 191)
    s, t = (rows - top)[:, None, None], (columns - left)[None, :, None]
    at = (
        whole[top][:, left] * (1 - s) * (1 - t)
        + whole[top + 1][:, left] * s * (1 - t)
        + whole[top][:, left + 1] * (1 - s) * t
        + whole[top + 1][:, left + 1] * s * t
    )
    expected = (at[1:, 1:] - at[:-1, 1:] - at[1:, :-1] + at[:-1, :-1]) / (96 * 192 / width / height)
    assert np.abs(area_resize(image, width, height) - expected).max() <= 0.5 + 1e-3


def test_whole_ratios_agree_with_pillow() -> None:
    image = np.random.default_rng(1).integers(0, 256, (64, 128, 3), dtype=np.uint8)
    ours = area_resize(image, 32, 16).astype(int)
    assert np.abs(ours - np.asarray(Image.fromarray(image).reduce(4)).astype(int)).max() <= 1


def test_enlarging_is_refused() -> None:
    with pytest.raises(ValueError, match="4x2 to 8x4: that is larger"):
        area_resize(np.zeros((2, 4, 3), np.uint8), 8, 4)
