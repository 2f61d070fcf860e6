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
    "cubemap_3dgs": "3DGS on cube faces",
    "crops_3dgs": "3DGS on crops",
    "sc_omnigs": "SC-OmniGS",
    "seam360gs": "Seam360GS",
}


def method_of(preset: str) -> str:
    """The method of a preset: the known name that it begins with, else itself.

    >>> method_of("odgs_release"), method_of("cubemap_3dgs"), method_of("my_own")
    ('odgs', 'cubemap_3dgs', 'my_own')
    """
    known = [method for method in TITLES if preset == method or preset.startswith(f"{method}_")]
    return known[0] if known else preset


def title(preset: str) -> str:
    """The name that people know, with the preset; that of the configuration where there is no other.

    >>> title("padgs"), title("odgs_release"), title("mine")
    ('PaD-GS', 'ODGS, release', 'mine')
    """
    method = method_of(preset)
    rest = preset.removeprefix(method).strip("_").replace("_", " ")
    return ", ".join(part for part in (TITLES.get(method, method), rest) if part)


def ordered(presets: Iterable[str]) -> list[str]:
    """Each preset once, in the order of the tables.

    >>> ordered(["mine", "padgs", "odgs_release", "odgs", "mine"])
    ['odgs', 'odgs_release', 'padgs', 'mine']
    """
    ranks = {name: rank for rank, name in enumerate(TITLES)}
    return sorted(set(presets), key=lambda preset: (ranks.get(method_of(preset), len(ranks)), preset))


def published_as(preset: str) -> str:
    """The method of the paper whose numbers a preset may stand beside: its own, or that of the released program.

    >>> published_as("odgs_release"), published_as("egonerf_small")
    ('odgs', 'egonerf_small')
    """
    return preset.removesuffix("_release")
