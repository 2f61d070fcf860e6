"""Find and load a native library, refuse one of another version, and time its calls on request."""

import ctypes
import importlib.util
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import torch  # noqa: F401 - first: the library then shares torch's OpenMP threads and thread count

Stage = Callable[[str], AbstractContextManager[object]]  # name of a function -> context of its call

_stages: list[Stage] = []  # the last one is active


@contextmanager
def call_hook(stage: Stage) -> Iterator[None]:
    """Make every call of a native library within `stage(name of the function)`, for timing."""
    _stages.append(stage)
    try:
        yield
    finally:
        _stages.pop()


class Library:
    """A loaded native library whose calls respect `call_hook`."""

    def __init__(self, loaded: ctypes.CDLL) -> None:
        self._loaded = loaded

    def __getattr__(self, name: str) -> Any:
        function = getattr(self._loaded, name)
        if not _stages:
            return function

        def call(*arguments: Any) -> Any:
            with _stages[-1](name):
                return function(*arguments)

        return call


def find_library(stem: str, requirement: str) -> ctypes.CDLL:
    """Load lib`stem` from this package, or from PADGS_LIBRARY_DIR; OSError if it is missing or does not load."""
    suffix = {"darwin": ".dylib", "win32": ".dll"}.get(sys.platform, ".so")
    name = ("" if sys.platform == "win32" else "lib") + stem + suffix
    folders = [Path(folder) for folder in _package_folders()]
    if "PADGS_LIBRARY_DIR" in os.environ:
        folders.insert(0, Path(os.environ["PADGS_LIBRARY_DIR"]))
    for folder in folders:
        if (folder / name).exists():
            return ctypes.CDLL(str(folder / name))
    raise OSError(
        f"{name} not found in {', '.join(map(str, folders))}; install padgs with {requirement}, or use backend=torch"
    )


def succeeds(load: Callable[[], object]) -> bool:
    """Return whether a library can be loaded and used, as `load` does."""
    try:
        load()
    except (OSError, RuntimeError):
        return False
    return True


def _package_folders() -> list[str]:
    spec = importlib.util.find_spec("padgs.native")
    return list(spec.submodule_search_locations or []) if spec else []


def declare(
    loaded: ctypes.CDLL, signatures: Mapping[str, tuple[list, Any]], bytes_of: str, structures: Sequence[type]
) -> Library:
    """Set the types of a library's functions; OSError if a function is missing, or a structure has another size."""
    for name, (arguments, result) in signatures.items():
        if not hasattr(loaded, name):
            raise OSError(f"{loaded._name} is of another version, without {name}; build it again")
        function = getattr(loaded, name)
        function.argtypes, function.restype = arguments, result
    for index, structure in enumerate(structures):  # another layout would be read as nonsense
        if getattr(loaded, bytes_of)(index) != ctypes.sizeof(structure):
            raise OSError(f"{loaded._name} is of another version, with another {structure.__name__}; build it again")
    return Library(loaded)
