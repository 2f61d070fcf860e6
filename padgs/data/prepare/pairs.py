"""Pairs of panoramas to match: all of a few; of many those taken one after the other, and those that look alike."""

from collections.abc import Callable, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np

from padgs.data.capture import natural_key
from padgs.data.formats.colmap_lens import pycolmap_module

PAIRS = ("auto", "exhaustive", "sequential", "similar")
EXHAUSTIVE_UP_TO = 60  # images: 1770 pairs
_NEIGHBOURS = 10  # following images in natural order
_ALIKE = 10  # most similar images of each; twice as many where the order of the names means nothing
_WORDS, _SAMPLE = 64, 40_000  # of the vocabulary, and descriptors that it is found from


def image_pairs(
    names: Sequence[str], kind: str = "auto", similarity: Callable[[Sequence[str]], np.ndarray] | None = None
) -> list[tuple[str, str]]:
    """Return pairs of names to match, each once.

    `sequential` sorts the names naturally and pairs every image with the next ten and with those 16, 32, 64, ...
    further on. `similar` pairs every image with the twenty most similar ones by `similarity`, which returns a matrix
    [n, n]. `auto` pairs up to 60 images exhaustively, and of more the sequential ones and the ten most similar.

    >>> image_pairs(["a", "b", "c"])
    [('a', 'b'), ('a', 'c'), ('b', 'c')]
    """
    names = sorted(names, key=natural_key)
    if kind == "exhaustive" or (kind == "auto" and len(names) <= EXHAUSTIVE_UP_TO):
        return list(combinations(names, 2))
    pairs: set[tuple[int, int]] = set()
    if kind != "similar":
        steps = [*range(1, _NEIGHBOURS + 1), *(2**k for k in range(4, 32) if 2**k < len(names))]
        pairs = {(i, i + step) for i in range(len(names)) for step in steps if i + step < len(names)}
    if kind != "sequential":
        assert similarity is not None
        alike = similarity(names)
        np.fill_diagonal(alike, -np.inf)
        count = 2 * _ALIKE if kind == "similar" else _ALIKE
        best = np.argsort(-alike, axis=1, kind="stable")[:, : min(count, len(names) - 1)]
        pairs |= {(min(i, int(j)), max(i, int(j))) for i, row in enumerate(best) for j in row}
    return [(names[i], names[j]) for i, j in sorted(pairs)]


def similarities(database: Path, images: Sequence[Sequence[str]], seed: int) -> np.ndarray:
    """Return the similarity [n, n] of panoramas, wherever they look, by features' residuals to a vocabulary (VLAD)."""
    from scipy.cluster.vq import kmeans2, vq

    random, count = np.random.default_rng(seed), len(images)
    with pycolmap_module().Database.open(database) as entries:
        ids = {image.name: image.image_id for image in entries.read_all_images()}

        def features(group: Sequence[str]) -> np.ndarray:  # read twice: those of all panoramas may fill the memory
            found = np.concatenate([entries.read_descriptors(ids[name]).data for name in group]).astype(np.float32)
            return np.sqrt(found / np.maximum(found.sum(1, keepdims=True), 1))  # RootSIFT

        sample = np.concatenate([random.permutation(features(group))[: -(-_SAMPLE // count)] for group in images])
        if len(sample) < _WORDS:
            return np.zeros((count, count))
        words, _ = kmeans2(sample, sample[random.permutation(len(sample))[:_WORDS]], iter=10, minit="matrix")
        signatures = np.zeros((count, *words.shape), np.float32)
        for index, group in enumerate(images):
            if len(found := features(group)):
                word, _ = vq(found, words)
                np.add.at(signatures[index], word, found - words[word])
    signatures /= np.maximum(np.linalg.norm(signatures, axis=2, keepdims=True), 1e-9)
    flat = signatures.reshape(count, -1)
    return flat @ flat.T
