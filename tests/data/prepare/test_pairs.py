"""Pairs to match."""

import pytest

from padgs.data import DataError
from padgs.data.prepare.sfm import EXHAUSTIVE_UP_TO, image_pairs

NAMES = [f"{index:04d}" for index in range(500)]


def test_few_images_are_all_paired():
    pairs = image_pairs(NAMES[:EXHAUSTIVE_UP_TO])
    assert len(pairs) == len(set(pairs)) == EXHAUSTIVE_UP_TO * (EXHAUSTIVE_UP_TO - 1) // 2
    assert image_pairs(NAMES[:200], "exhaustive")[-1] == ("0198", "0199")


def test_many_images_are_paired_with_neighbours_and_some_far_ones():
    pairs = set(image_pairs(NAMES))
    assert len(pairs) < 20 * len(NAMES)
    assert all(a < b for a, b in pairs)
    for step in (*range(1, 11), 16, 32, 64, 128, 256):
        assert ("0100", f"{100 + step:04d}") in pairs
    assert ("0100", "0111") not in pairs
    assert ("0000", "0499") in pairs  # a path that comes back to its start


def test_order_of_names_does_not_matter():
    assert image_pairs(NAMES[::-1]) == image_pairs(NAMES)


def test_numbers_without_leading_zeros_count_by_their_value():
    pairs = image_pairs([f"pano{number}.jpg" for number in range(1, 121)], "sequential")
    assert ("pano9.jpg", "pano10.jpg") in pairs and ("pano10.jpg", "pano100.jpg") not in pairs


def test_unknown_kind():
    with pytest.raises(DataError, match="unknown kind of pairs 'all'; known: auto, exhaustive, sequential"):
        image_pairs(NAMES, "all")
