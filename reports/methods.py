"""How methods and their presets are called in tables, and in what order: the paper's, then the others."""

from __future__ import annotations

from collections.abc import Iterable

TITLES = {
    "egonerf": "EgoNeRF",
    "op43dgs": "OP43DGS",
    "odgs": "ODGS",
    "omnigs": "OmniGS",
    "spags": "SPaGS",
    "padgs": "PaD-GS",
}


def title(preset: str) -> str:
    """The name that people know, with the preset; that of the configuration where there is no other.

    >>> title("padgs"), title("odgs_release"), title("mine")
    ('PaD-GS', 'ODGS, release', 'mine')
    """
    method, _, rest = preset.partition("_")
    name = TITLES.get(method)
    return preset if name is None else f"{name}, {rest.replace('_', ' ')}" if rest else name


def ordered(presets: Iterable[str]) -> list[str]:
    """Each preset once, in the order of the tables.

    >>> ordered(["mine", "padgs", "odgs_release", "odgs", "mine"])
    ['odgs', 'odgs_release', 'padgs', 'mine']
    """
    ranks = {name: rank for rank, name in enumerate(TITLES)}
    return sorted(set(presets), key=lambda preset: (ranks.get(preset.partition("_")[0], len(ranks)), preset))


def published_as(preset: str) -> str:
    """The method of the paper whose numbers a preset may stand beside: its own, or that of the released program.

    >>> published_as("odgs_release"), published_as("egonerf_small")
    ('odgs', 'egonerf_small')
    """
    return preset.removesuffix("_release")
