"""`padgs-run --help`: every key with its default and its meaning, the comment of its field."""

import inspect
import re
import shutil
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

from padgs.baselines import METHODS
from padgs.data.datasets import DATASETS
from padgs.multirun.composition import composing, configuration, variant_choices
from padgs.multirun.overrides import root
from padgs.runs.config import DataConfig, Settings, scene_choices

USAGE = """\
padgs-run [KEY=VALUE ...]     one run, scored; by default padgs+ on a generated room
padgs-run -m KEY=A,B ...      one run for each value, or each combination of values
padgs-run --cfg job           print the configuration, run nothing
padgs-run --help method=NAME  print this text, with the keys of that method
padgs-run --version           print the version
"""
GROUPS = ("method", "+experiment", "+sweep", "+scene", "data", "protocol", "render", "train", "budget", "+scale")
GROUPS += ("launcher", "tracking")
# The comment above a field, its name, and the comment beside it with its following lines.
COMMENTED = re.compile(r"^((?:    # .*\n)*)    (\w+): [^#\n]*?(?:  # (.*(?:\n {5,}# .*)*))?$", re.MULTILINE)


def manual(arguments: Sequence[str], width: int | None = None) -> str:
    """Return the help text for a command line and a terminal of `width` columns, by default the current one."""
    with composing():
        config = configuration([text for text in arguments if text.startswith("method=")])
    width = width or min(shutil.get_terminal_size().columns, 120)
    lines = [USAGE, "Choices:"]
    variants = {f"+{table}": rows for table, rows in variant_choices().items()}
    for group in (*GROUPS, *variants):
        folder = root() / ("sweeps" if group == "+sweep" else "conf") / group.lstrip("+")
        registered = {"method": METHODS, "+scene": scene_choices(), **variants}.get(group, ())
        names = ", ".join(sorted({path.stem for path in folder.glob("*.yaml")} | set(map(_shortened, registered))))
        lines += textwrap.wrap(names, width, initial_indent=f"  {group}=", subsequent_indent=" " * 6)
    lines += ["", f"Keys, with their defaults under method={config.preset}:"]
    common = Settings(**{field.name: getattr(config, field.name) for field in fields(Settings)})
    for key, value, meaning in (*keys(common), *keys(config.options, "method.")):
        shown = "null" if value is None else str(value).lower() if isinstance(value, bool) else value
        line = f"{f'  {key}={shown}':<34}  {meaning}".rstrip()
        lines += textwrap.wrap(line, width, subsequent_indent=" " * 36)
    return "\n".join(lines)


def _shortened(choice: str) -> str:
    """Return a choice; the many scenes of data sets in nested folders have one entry, such as ob3d_FOLDER_SCENE."""
    known = DATASETS.get(choice.partition("_")[0])
    return f"{choice.partition('_')[0]}_FOLDER_SCENE" if known and known.nested else choice


def keys(options: Any, where: str = "") -> Iterator[tuple[str, Any, str]]:
    """Yield dotted key, default and meaning of each field of a dataclass and of nested dataclasses."""
    meanings = {
        field: " ".join(re.sub(r"\s*# ", " ", above + beside).split())
        for base in reversed(type(options).__mro__[:-1])
        for above, field, beside in COMMENTED.findall(inspect.getsource(base))
        if above + beside
    }
    for field in fields(options):
        value = getattr(options, field.name)
        if is_dataclass(value):
            yield from keys(value, f"{where}{field.name}.")
        elif field.name == "generator" and isinstance(options, DataConfig):
            yield from keys(options.synthetic, f"{where}{field.name}.")
        elif field.init:
            yield f"{where}{field.name}", value, meanings.get(field.name, "")
