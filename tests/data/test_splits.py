from pathlib import Path

import pytest

from padgs.data.capture import DataError
from padgs.data.splits import read_list, split_frames

NAMES = ("a.jpg", "b.jpg", "c.jpg", "sub/d.png", "sub/e.png")


def _lists(folder: Path, train: str | None, test: str | None) -> Path:
    for name, text in (("train.txt", train), ("test.txt", test)):
        if text is not None:
            (folder / name).write_bytes(text.encode())
    return folder


@pytest.mark.parametrize(
    ("train", "test"),
    [
        ("a.jpg\nb.jpg\nsub/d.png\n", "c.jpg\nsub/e.png\n"),
        ("a\nb\nsub/d", "c\nsub/e"),
        ("\ufeffa\r\n\r\n  b  \r\nd.png\r\n", "\r\nc\r\nsub\\e.png\r\n"),
        ("images/a.jpg\nimages/b.jpg\nd\n", "images/c\ne"),
        ("/data/a.jpg\nC:\\data\\b.JPG\nd.jpg\n", "../c.jpg\n..\\sub\\e.png"),
    ],
    ids=["full names", "stems", "windows", "other folders", "elsewhere"],
)
def test_list_files_in_all_notations(train: str, test: str, tmp_path: Path) -> None:
    split = split_frames(NAMES, _lists(tmp_path, train, test))
    assert (split.train, split.test) == ((0, 1, 3), (2, 4))
    assert split.notes == ("split: train.txt and test.txt",)


def test_lists_in_the_unicode_of_windows(tmp_path: Path) -> None:
    (tmp_path / "test.txt").write_text("b\r\nsub/d.png\r\n", encoding="utf-16")
    assert split_frames(NAMES, tmp_path).test == (1, 3)


def test_a_missing_list_is_completed(tmp_path: Path) -> None:
    split = split_frames(NAMES, _lists(tmp_path, None, "b"))
    assert (split.train, split.test) == ((0, 2, 3, 4), (1,))
    assert "there is no train list; all views missing from the test list are used" in split.notes


def test_every_kth(tmp_path: Path) -> None:
    names = [f"{i:02}.jpg" for i in range(17)]
    assert split_frames(names, tmp_path).test == (0, 8, 16)
    assert split_frames(names, _lists(tmp_path, "01", "02"), mode="every", every=5).test == (0, 5, 10, 15)
    everything = split_frames(names, tmp_path, mode="all")
    assert (len(everything.train), everything.test) == (17, ())


@pytest.mark.parametrize(
    ("mode", "stated"), [("auto", None), ("files", None), ("all", None), ("auto", {"test": ("b",)})]
)
def test_a_step_that_decides_nothing_is_refused(mode: str, stated, tmp_path: Path) -> None:
    folder = tmp_path if stated else _lists(tmp_path, None, "b")
    with pytest.raises(
        DataError, match=r"data.test_every=4 changes nothing beside .*; leave it out, or set data.split=every"
    ):
        split_frames(NAMES, folder, mode=mode, every=4, stated=stated)


def test_the_split_of_the_format_takes_precedence(tmp_path: Path) -> None:
    _lists(tmp_path, "a", "b")
    stated = {"train": ("c.jpg",), "test": ("sub/d.png",)}
    assert split_frames(NAMES, tmp_path, stated=stated).train == (2,)
    assert split_frames(NAMES, tmp_path, stated=stated, mode="files").train == (0,)


def test_lists_may_name_what_is_left_out_which_stands_for_no_other_image(tmp_path: Path) -> None:
    names, left_out = ["panos/1.jpg", "panos/2.jpg", "panos/3.jpg"], ["photos/1.jpg"]
    folder = _lists(tmp_path, "panos/1.jpg\npanos/3", "photos/1.jpg\n2.jpg")
    split = split_frames(names, folder, left_out=left_out)
    assert (split.train, split.test) == ((0, 2), (1,))
    with pytest.raises(DataError, match="names '1.jpg', which matches panos/1.jpg, photos/1.jpg; be specific"):
        split_frames(names, _lists(tmp_path, "1.jpg", "2.jpg"), left_out=left_out)


def test_a_line_names_no_image_that_only_ends_alike(tmp_path: Path) -> None:
    names, folder = ["floor1/0001.jpg", "floor1/0002.jpg"], _lists(tmp_path, "0002", "floor2/0001.jpg")
    with pytest.raises(DataError, match="names images that do not exist: 'floor2/0001.jpg'"):
        split_frames(names, folder)
    with pytest.raises(DataError, match="names images that have no pose: floor2/0001.jpg"):
        split_frames(names, folder, unposed=["floor2/0001.jpg"])
    assert split_frames(names, _lists(tmp_path, "0002", "scan/floor1/0001")).test == (0,), "a folder more"


def test_unused_views_are_reported(tmp_path: Path) -> None:
    assert "3 posed views are in neither list and are not used" in split_frames(NAMES, _lists(tmp_path, "a", "b")).notes


@pytest.mark.parametrize(
    ("train", "test", "message"),
    [
        ("a\nb", "b\nc", "train and test list overlap: b.jpg; a view is one or the other"),
        ("a\nx\ny", "b", r"train list \S*train.txt names images that do not exist: 'x', 'y'; a line is one name, and"),
        ("a.jpg, b.jpg", "b", "do not exist: 'a.jpg, b.jpg'; a line is one name"),
        ("a\nlost", "b", r"the train list \S*train.txt names images that have no pose: lost; remove them"),
        ("a", "\n\n", "the test split is empty; name at least one view, or set data.split to every, or to all"),
        ("", "a", "the train split is empty"),
        ("../../etc/passwd", "a", "names images that do not exist: '../../etc/passwd'"),
    ],
)
def test_unusable_lists(train: str, test: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=message):
        split_frames(NAMES, _lists(tmp_path, train, test), unposed=["lost.jpg"])


def test_ambiguous_names(tmp_path: Path) -> None:
    names = ("left/a.jpg", "right/a.jpg", "b.jpg")
    with pytest.raises(DataError, match="names 'a', which matches left/a.jpg, right/a.jpg; be specific"):
        split_frames(names, _lists(tmp_path, "a", "b"))
    assert split_frames(names, _lists(tmp_path, "left/a", "b")).train == (0,)


def test_too_few_views_and_no_lists(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="cannot be split; at least 2"):
        split_frames(["a.jpg"], tmp_path)
    with pytest.raises(DataError, match="holds no train.txt, no test.txt"):
        split_frames(NAMES, tmp_path, mode="files")


def test_list_files_must_be_utf8(tmp_path: Path) -> None:
    (tmp_path / "train.txt").write_bytes(b"\x81\xfe\x00\xff")
    with pytest.raises(DataError, match="train.txt cannot be read as UTF-8 text"):
        read_list(tmp_path / "train.txt")


def test_lists_are_found_in_any_case_and_said_to_be_unused_beside_a_stated_split(tmp_path: Path) -> None:
    (tmp_path / "Test.txt").write_text("b\n")
    assert split_frames(NAMES, tmp_path).test == (1,)
    stated = split_frames(NAMES, tmp_path, stated={"test": ("c.jpg",)})
    assert stated.test == (2,) and stated.notes[0].endswith("Test.txt not used: data.split=files uses them")
    assert split_frames(NAMES, tmp_path, stated={"test": ("c.jpg",)}, mode="files").test == (1,)


def test_lists_beside_the_model_as_in_the_released_3dgs(tmp_path: Path) -> None:
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    (tmp_path / "sparse" / "0" / "test.txt").write_text("b\n")
    assert split_frames(NAMES, tmp_path).test == (1,)
    (tmp_path / "test.txt").write_text("c\n")
    assert split_frames(NAMES, tmp_path).test == (2,)


def test_names_with_separators_of_unicode_are_one_line(tmp_path: Path) -> None:
    for name in ("a\u2028b.jpg", "a\x85b.jpg", "a\x0bb.jpg"):
        (tmp_path / "test.txt").write_text(f"{name}\r\n", encoding="utf-8")
        assert read_list(tmp_path / "test.txt") == (name,)
    (tmp_path / "test.txt").write_text("")
    assert read_list(tmp_path / "test.txt") == ()
