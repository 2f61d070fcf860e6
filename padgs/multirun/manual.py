"""`padgs-run --help`: every key with its default and its meaning, which is the comment of the field that it is."""

from __future__ import annotations

import inspect
import re
import shutil
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

from padgs.baselines import METHODS
from padgs.data.synthetic.options import SyntheticOptions
from padgs.multirun.choices import scene_choices
from padgs.multirun.composition import composing, configuration
from padgs.multirun.overrides import root
from padgs.runs.config import Settings

USAGE = """\
padgs-run [KEY=VALUE ...]     one run, scored; by default padgs+ on a built-in room
padgs-run -m KEY=A,B ...      one run for each value; lists multiply
padgs-run --cfg job           the configuration, not run
padgs-run --help method=NAME  this text, with the keys of that method
padgs-run --version           and stop; --hydra-help says what else Hydra understands
"""
CHOSEN = (
    *("method", "experiment", "sweep", "scene", "data", "protocol"),
    *("render", "budget", "scale", "launcher", "tracking"),
)
# The comment above a field, its name, and the comment beside it, which may go on below.
COMMENTED = re.compile(r"^((?:    # .*\n)*)    (\w+): [^#\n]*?(?:  # (.*(?:\n {5,}# .*)*))?$", re.MULTILINE)
ADDED = ("experiment", "sweep", "scene", "scale")  # groups that only a + brings in


def manual(arguments: Sequence[str], width: int | None = None) -> str:
    """The text for a command line and a terminal of so many columns, by default the one that there is.

    Raises:
        HydraException: there is no method of the name that it says.
    """
    chosen = [text for text in arguments if text.startswith("method=")]
    with composing():
        config = configuration(chosen)
    width = width or min(shutil.get_terminal_size().columns, 120)
    lines = [USAGE, "Choices:"]
    for group, names in choices().items():
        lines += textwrap.wrap(", ".join(names), width, initial_indent=f"  {group}=", subsequent_indent=" " * 6)
    lines += ["", f"Keys, with their defaults under method={config.preset}:"]
    common = {field.name: getattr(config, field.name) for field in fields(Settings)}
    for key, value, meaning in (*keys(Settings(**common)), *keys(config.options, "method.")):
        shown = "null" if value is None else str(value).lower() if isinstance(value, bool) else value
        head = f"  {key}={shown}"
        lines += textwrap.wrap(f"{head:<34}  {meaning}".rstrip(), width, subsequent_indent=" " * 36)
    return "\n".join(lines)


def choices() -> dict[str, list[str]]:
    """Group, with the + that it may need -> the names in it."""
    found, made = {}, {"method": METHODS, "scene": scene_choices()}
    for group in CHOSEN:
        folder = root() / ("sweeps" if group == "sweep" else "conf") / group
        names = {path.stem for path in folder.glob("*.yaml")} | {*made.get(group, ())}
        if names:
            found[f"+{group}" if group in ADDED else group] = sorted(names)
    return found


def keys(options: Any, where: str = "") -> Iterator[tuple[str, Any, str]]:
    """Dotted key, default and meaning of each field of a dataclass, those of nested ones in their place."""
    said = meanings(type(options))
    for field in fields(options):
        value = getattr(options, field.name)
        if is_dataclass(value):
            yield from keys(value, f"{where}{field.name}.")
        elif field.name == "generator" and isinstance(value, Mapping):
            yield from keys(SyntheticOptions(), f"{where}{field.name}.")
        elif field.init:
            yield f"{where}{field.name}", value, said.get(field.name, "")


def meanings(kind: type) -> dict[str, str]:
    """Field -> the comment above it or on its line, in a dataclass or in what it derives from."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        for above, field, beside in COMMENTED.findall(inspect.getsource(base)):
            if said := " ".join(re.sub(r"\s*# ", " ", above + beside).split()):
                found[field] = said
    return found
