"""Finds and loads the native library; importing this module loads nothing."""

from __future__ import annotations


def available() -> bool:
    """Whether the native CPU library is built and loads."""
    return False
