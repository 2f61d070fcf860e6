"""Titles of methods and presets in reports, and their order: the paper's, then the others."""

from __future__ import annotations

from collections.abc import Iterable

TITLES = {
    "egonerf": "EgoNeRF",
    "op43dgs": "OP43DGS",
    "odgs": "ODGS",
    "omnigs": "OmniGS",
    "spags": "SPaGS",
    "padgs": "PaD-GS",
    "padgs_plus": "padgs+",
    "cubemap_3dgs": "3DGS on cube faces",
    "crops_3dgs": "3DGS on crops",
    "sc_omnigs": "SC-OmniGS",
    "seam360gs": "Seam360GS",
}
# preset -> how ours differs from the published program, where the name of the preset does not say it
STATUS = {
    **dict.fromkeys(("op43dgs", "odgs", "omnigs"), "corrected"),  # the releases, without their mistakes
    **dict.fromkeys(("op43dgs_release", "odgs_release"), "as released, gradients corrected"),
    **dict.fromkeys(("omnigs_release", "padgs_release"), "as released"),
    "sc_omnigs": "after the abstract and project page",
    "seam360gs": "after the abstract",
    "spags_narrow": "sorted, narrow filter",
    "spags_tuned": "sorted, options of padgs+",
}


def method_of(preset: str) -> str:
    """Return the method of a preset: the longest known name that it begins with, else the preset.

    >>> method_of("odgs_release"), method_of("padgs_plus"), method_of("my_own")
    ('odgs', 'padgs_plus', 'my_own')
    """
    known = [method for method in TITLES if preset == method or preset.startswith(f"{method}_")]
    return max(known, key=len, default=preset)


def name(method: str) -> str:
    """Return the authors' name of a method, or else its name in the configuration."""
    return TITLES.get(method, method)


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
    ranks = {method: rank for rank, method in enumerate(TITLES)}
    return sorted(set(presets), key=lambda preset: (ranks.get(method_of(preset), len(ranks)), preset))


def published_as(preset: str) -> str:
    """Return the method of the paper whose numbers a preset may stand beside, for releases that of the program.

    >>> published_as("odgs_release"), published_as("egonerf_small")
    ('odgs', 'egonerf_small')
    """
    return preset.removesuffix("_release")
