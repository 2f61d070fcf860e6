"""Which pairs of images are worth matching: all of a few, neighbours and some far ones of many."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

from padgs.data.errors import DataError
from padgs.data.natural_order import natural

PAIRS = ("auto", "exhaustive", "sequential")
EXHAUSTIVE_UP_TO = 80  # images: 3160 pairs
_NEIGHBOURS = 10  # images before and after in the order of their names, each
_ANCHORS = 30  # images spread over the sequence, all matched with each other


def image_pairs(names: Sequence[str], kind: str = "auto") -> list[tuple[str, str]]:
    """Pairs of names to match, each once.

    `sequential` takes the names in order, numbers in them by their value: every image with the next ten and with those
    16, 32, 64, ... further on; to notice that a path returns, 30 images spread over the sequence are also matched with
    each other.

    >>> image_pairs(["a", "b", "c"])
    [('a', 'b'), ('a', 'c'), ('b', 'c')]
    """
    if kind not in PAIRS:
        raise DataError(f"unknown kind of pairs {kind!r}; known: {', '.join(PAIRS)}")
    names = sorted(names, key=natural)
    if kind == "exhaustive" or (kind == "auto" and len(names) <= EXHAUSTIVE_UP_TO):
        return list(combinations(names, 2))
    steps = [*range(1, _NEIGHBOURS + 1), *(2**k for k in range(4, 32) if 2**k < len(names))]
    near = {(i, i + step) for i in range(len(names)) for step in steps if i + step < len(names)}
    anchors = sorted({round(k * (len(names) - 1) / (_ANCHORS - 1)) for k in range(_ANCHORS)})
    return [(names[i], names[j]) for i, j in sorted(near | set(combinations(anchors, 2)))]
