"""Titles, colours and order of methods and presets (`methods.yaml`): the paper's, then the others."""

import re
from collections.abc import Iterable
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path

import yaml

from padgs.checks import printable

METHODS = yaml.safe_load(Path(__file__).with_name("methods.yaml").read_text("utf-8"))
STATUS = {preset: words for method in METHODS.values() for preset, words in method.get("presets", {}).items()}
COLOR = re.compile("#[0-9a-fA-F]{6}")
OTHERS = tuple(point.name for point in entry_points(group="padgs.methods"))  # methods of other packages
EXTERNAL = "external: "  # presets of models and renders that another program made begin with it; their label follows


@cache
def outside(method: str, attribute: str) -> str:
    """Return a text of the class of a method of another package, e.g. title or color (#rrggbb); else empty."""
    for point in entry_points(group="padgs.methods", name=method):
        try:
            value = getattr(point.load(), attribute, "")
        except Exception:  # of a package that does not work; a run that needs it says so
            return ""
        if isinstance(value, str) and (attribute != "color" or COLOR.fullmatch(value)):
            return printable(value, kept="")
    return ""


def color(method: str) -> str:
    """Return the colour of a method as #rrggbb; empty if it has none."""
    return METHODS[method]["color"] if method in METHODS else outside(method, "color")


def method_of(preset: str) -> str:
    """Return the method of a preset: the longest known name that it begins with, else the preset.

    >>> method_of("odgs_release"), method_of("padgs_plus"), method_of("my_own")
    ('odgs', 'padgs_plus', 'my_own')
    """
    known = [method for method in (*METHODS, *OTHERS) if preset == method or preset.startswith(f"{method}_")]
    return max(known, key=len, default=preset)


def name(method: str) -> str:
    """Return the authors' name of a method, or else its name in the configuration; labels of other programs' models."""
    if method.startswith(EXTERNAL):
        return f"{method.removeprefix(EXTERNAL)} (external)"
    return METHODS[method]["title"] if method in METHODS else outside(method, "title") or method


def title(preset: str) -> str:
    """Return the authors' name with what distinguishes ours from their program, or with the preset.

    >>> title("padgs"), title("odgs"), title("padgs_ray"), title("mine")
    ('PaD-GS', 'ODGS, corrected', 'PaD-GS, ray', 'mine')
    """
    method = method_of(preset)
    rest = STATUS.get(preset, preset.removeprefix(method).strip("_").replace("_", " "))
    return ", ".join(part for part in (name(method), rest) if part)


def short(long_title: str, preset: str) -> str:
    """Shorten a title that begins with the preset's own, for a marker in a chart: without its status.

    >>> short("ODGS, corrected, iterations 300", "odgs"), short(title("odgs_release"), "odgs_release")
    ('ODGS, iterations 300', 'ODGS, release')
    """
    method = method_of(preset)
    rest = preset.removeprefix(method).replace("_", " ").replace(" ", ", ", 1)
    return long_title.replace(title(preset), name(method) + rest, 1)


def ordered(presets: Iterable[str]) -> list[str]:
    """Return each preset once, in the order of the tables.

    >>> ordered(["mine", "padgs", "odgs_release", "odgs", "mine"])
    ['odgs', 'odgs_release', 'padgs', 'mine']
    """
    ranks = {method: rank for rank, method in enumerate(METHODS)}
    return sorted(set(presets), key=lambda preset: (ranks.get(method_of(preset), len(ranks)), preset))


def published_as(preset: str) -> str:
    """Return the method of the paper whose numbers a preset may stand beside, for releases that of the program.

    >>> published_as("odgs_release"), published_as("egonerf_small")
    ('odgs', 'egonerf_small')
    """
    return preset.removesuffix("_release")
