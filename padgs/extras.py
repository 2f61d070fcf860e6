"""Extras of pyproject.toml: packages that only some commands need."""

from __future__ import annotations

import shlex
import sys


def installing(extra: str) -> str:
    """The command that installs an extra for the Python that runs this, whichever `pip` would be found first.

    >>> installing("video").partition(" -m ")[2]
    "pip install 'padgs[video]'"
    """
    return shlex.join([sys.executable, "-m", "pip", "install", f"padgs[{extra}]"])
