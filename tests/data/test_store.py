"""The cache of decoded images: bounded, shared, deterministic, and errors reach who asks."""

import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from padgs.data.capture import DataError
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


def test_never_more_than_the_limit_and_the_oldest_goes_first(files: list[Path]) -> None:
    store = ImageStore(limit_bytes=2 * BYTES, threads=0)
    images = [StoredImage(path, 32, 16, store) for path in files]
    for i in (0, 1, 0, 2, 0, 1):  # 1 goes when 2 comes, 2 goes when 1 comes back
        assert torch.equal(images[i](), _expected(files[i]))
        assert store.bytes <= 2 * BYTES
    assert store.decoded == 4


def test_without_a_cache_everything_is_decoded_every_time(files: list[Path]) -> None:
    store = ImageStore(limit_bytes=0, threads=0)
    image = StoredImage(files[0], 32, 16, store)
    assert torch.equal(image(), image())
    assert store.decoded == 2 and store.bytes == 0


@pytest.mark.parametrize("threads", [0, 1, 3])
def test_values_do_not_depend_on_reading_ahead(threads: int, files: list[Path]) -> None:
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


def test_an_error_in_the_background_is_raised_in_the_foreground(files: list[Path]) -> None:
    store = ImageStore(threads=1)
    files[0].write_bytes(files[0].read_bytes()[:300])
    image = StoredImage(files[0], 32, 16, store)
    image.prefetch()
    for _ in range(2):  # and again, not once only
        with pytest.raises(DataError, match="0.png is cut short"):
            image()
