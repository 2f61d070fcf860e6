"""Checks of input and machine before `prepare` works."""

from pathlib import Path

import pytest
from PIL import Image

from padgs.data import DataError
from padgs.data.prepare import work
from padgs.data.prepare.work import PrepareOptions, check_options, free_memory, threads_for

GIGABYTE = 10**9


@pytest.mark.parametrize("name", ["mask.png", "Mask.JPG"])
def test_a_mask_beside_a_video_is_used_or_not_by_name_only(name: str, tmp_path: Path) -> None:
    video, mask = tmp_path / "tour.mp4", tmp_path / name
    video.write_bytes(b"a film")
    check_options(video, PrepareOptions())
    Image.new("L", (32, 16), 255).save(mask)
    way_out = f"{mask} lies beside the video: use it with --mask {mask}, or not with --mask none"
    with pytest.raises(DataError, match=way_out):
        check_options(video, PrepareOptions())
    for spec in ("none", str(mask), f"inverted:{mask}"):
        check_options(video, PrepareOptions(mask=spec))
    check_options(tmp_path, PrepareOptions())


def limited(folder: Path, limit: str, used: int, cached: int) -> None:
    """Write the files of a control group that is limited."""
    (folder / "memory.max").write_text(f"{limit}\n")
    (folder / "memory.current").write_text(f"{used}\n")
    (folder / "memory.stat").write_text(f"anon {used - cached}\nfile {cached}\nkernel 7\n")


def test_the_memory_of_a_container_is_that_of_its_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(work, "CGROUP", tmp_path)
    monkeypatch.setattr(work, "linux_value", lambda *_: "8000000 kB")
    monkeypatch.setattr(work, "cores", lambda: 8)
    assert free_memory() == 8 * 1024 * 10**6 and threads_for(2048, 1024) == 8, "no control group"
    limited(tmp_path, str(4 * GIGABYTE), used=3 * GIGABYTE, cached=GIGABYTE // 2)
    assert free_memory() == 1.5 * GIGABYTE and threads_for(2048, 1024) == 2, "the page cache can be freed"
    limited(tmp_path, "max", used=3 * GIGABYTE, cached=0)
    assert free_memory() == 8 * 1024 * 10**6, "no limit"
    limited(tmp_path, str(9 * GIGABYTE), used=0, cached=0)
    assert free_memory() == 8 * 1024 * 10**6, "the machine has less"
    limited(tmp_path, str(GIGABYTE), used=2 * GIGABYTE, cached=0)
    assert free_memory() == 0 and threads_for(2048, 1024) == 1
    monkeypatch.setattr(work, "linux_value", lambda *_: "")
    assert free_memory() == 0
    limited(tmp_path, "max", used=0, cached=0)
    assert free_memory() is None
