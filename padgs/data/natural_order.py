"""The order in which people count: view_2 before view_10."""

from __future__ import annotations

import re
from typing import Any

_NUMBER = re.compile(r"(\d+)")


def natural(name: str) -> tuple[list[Any], str]:
    """What to sort names by so that numbers in them stand by their value.

    >>> sorted(["view_10", "view_2", "door"], key=natural)
    ['door', 'view_2', 'view_10']
    """
    parts: list[Any] = _NUMBER.split(name)
    parts[1::2] = map(int, parts[1::2])
    return parts, name
