"""Which methods are shown beside the others but compete with none, and why."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from pandas import DataFrame

from padgs.reports.frame import CONFIG
from padgs.reports.methods import title
from padgs.reports.tables.table import UNRANKED

ENOUGH = 0.5  # of the images that another method of the block has seen
MENDS = {  # method -> keys of data.generator that make what it mends; in photographs it is of unknown size
    "sc_omnigs": ("pose_noise_translation", "pose_noise_rotation"),
    "seam360gs": ("lens_gap", "lens_k1"),
}
FEWER = "for it saw less than half as much of the training images as another method of its table"
NOTHING_TO_MEND = (
    "for it is made after an abstract, and nothing is known here of what it mends (noise of the training poses; two "
    "lenses apart); +experiment=calibration compares it where it is"
)


@dataclass(frozen=True)
class Reason:
    """Why a preset is not ranked in a block."""

    why: str
    numbers: str = ""


def unranked(runs: DataFrame, *, equal_images: bool = True) -> dict[str, Reason]:
    """Preset -> why its numbers are no better or worse than others of a block, for the presets of which they are not.

    Args:
        runs: all of the block.
        equal_images: whether methods are compared for what they make of as many images; else of as much time.
    """
    found: dict[str, Reason] = {}
    seen = runs.loc[runs["ok"]].groupby("preset")["images"].mean()
    for preset, images in seen[seen < ENOUGH * seen.max()].items() if equal_images else ():
        found[str(preset)] = Reason(FEWER, f"{images:.0f} of {seen.max():.0f} images")
    for method, keys in MENDS.items():
        own = runs.loc[runs["method"] == method]
        there = own.reindex(columns=[f"{CONFIG}data.generator.{key}" for key in keys]).fillna(0).astype(bool)
        generated = own["dataset"] == "synthetic"  # a folder's pictures have nothing of the generator
        mended = there.any(axis=1) & generated
        found |= dict.fromkeys(own.loc[~mended, "preset"], Reason(NOTHING_TO_MEND))
    return found


def notes(blocks: Iterable[Mapping[str, Reason]]) -> list[str]:
    """A sentence for each reason, with all whom it concerns in any of the blocks."""
    concerned: dict[str, dict[str, dict[str, None]]] = {}
    for preset, reason in (pair for block in blocks for pair in block.items()):
        concerned.setdefault(reason.why, {}).setdefault(title(preset), {})[reason.numbers] = None
    found = []
    for why, titles in sorted(concerned.items()):
        named = [f"{name} ({', '.join(numbers)})" if any(numbers) else name for name, numbers in titles.items()]
        found.append(f"{UNRANKED} Not ranked: {'; '.join(named)}: {why}.")
    return found
