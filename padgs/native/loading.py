"""Finding and loading a native library, and refusing one of another version."""

from __future__ import annotations

import ctypes
import importlib.util
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch  # noqa: F401 - first: the library then shares torch's OpenMP threads and thread count

from padgs.native.watch import Watchable


def opened(stem: str, needs: str) -> ctypes.CDLL:
    """The library lib`stem` of this package, or of the folder PADGS_LIBRARY_DIR while someone works on the kernels.

    Raises:
        OSError: it is not there, because there was no `needs` when padgs was installed, or does not load.
    """
    suffix = {"darwin": ".dylib", "win32": ".dll"}.get(sys.platform, ".so")
    name = ("" if sys.platform == "win32" else "lib") + stem + suffix
    folders = [Path(folder) for folder in _package_folders()]
    if "PADGS_LIBRARY_DIR" in os.environ:
        folders.insert(0, Path(os.environ["PADGS_LIBRARY_DIR"]))
    for folder in folders:
        if (folder / name).exists():
            return ctypes.CDLL(str(folder / name))
    raise OSError(
        f"{name} not found in {', '.join(map(str, folders))}; install padgs where there is {needs}, "
        "or render with backend=torch"
    )


def _package_folders() -> list[str]:
    spec = importlib.util.find_spec("padgs.native")
    return list(spec.submodule_search_locations or []) if spec else []


def declared(
    loaded: ctypes.CDLL, signatures: Mapping[str, tuple[list, Any]], bytes_of: str, structures: Sequence[type]
) -> Watchable:
    """The library with the types of its functions set, if it is one of ours and of this version.

    Raises:
        OSError: a function is missing, or a structure of the library has another size.
    """
    for name, (arguments, result) in signatures.items():
        if not hasattr(loaded, name):
            raise OSError(f"{loaded._name} is of another version, without {name}; build it again")
        function = getattr(loaded, name)
        function.argtypes, function.restype = arguments, result
    for index, structure in enumerate(structures):  # what is laid out differently would be read as nonsense
        if getattr(loaded, bytes_of)(index) != ctypes.sizeof(structure):
            raise OSError(f"{loaded._name} is of another version, with another {structure.__name__}; build it again")
    return Watchable(loaded)
