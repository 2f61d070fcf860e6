"""Command lines on their way to Hydra: what it is told, and the jobs that a multirun consists of."""

from __future__ import annotations

import itertools
import os
import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hydra.core.config_loader import ConfigLoader

# Keys that name files, with what is said of them; what Hydra is to read in it: nothing, null, quotes, groups, calls;
# one of several names.
FILES = re.compile(r"(\+*(?:data\.(?:path|images|points|mask)|run\.folder|init)=)(.*)", re.DOTALL)
GRAMMAR = re.compile(r"|null|(['\"]).*\1|\{.*\}|(choice|glob|shuffle|sort|tag)\(.*\)", re.DOTALL)
ONE_OF_SEVERAL = re.compile(r"\"[^\"]*\"|'[^']*'|[^,]+")


def root() -> Path:
    """The folder that holds `conf/` and `sweeps/`: the package where it is installed, else the checkout.

    Hydra resolves relative paths against the importing module, which a console script does not have.
    """
    package = Path(__file__).resolve().parent.parent
    return package if (package / "conf").is_dir() else package.parent


def options_first(arguments: Sequence[str]) -> list[str]:
    """Options and their values before settings: Hydra's parser refuses settings on both sides of an option.

    >>> options_first(["method=padgs", "-m", "seed=0,1", "--cfg", "job"])
    ['-m', '--cfg', 'job', 'method=padgs', 'seed=0,1']
    """
    is_setting = [not text.startswith("-") and ("=" in text or text.startswith("~")) for text in arguments]
    return [text for wanted in (False, True) for text, it in zip(arguments, is_setting, strict=True) if it == wanted]


def lenient(arguments: Sequence[str]) -> list[str]:
    """Let unknown keys pass Hydra, so that `config_from_values` refuses them and lists the known ones.

    `scale` is a group that experiments bring along; without an experiment it is added.

    >>> lenient(["method=padgs", "train.iteration=5", "+experiment=smoke", "-m", "seed=1,2"])
    ['method=padgs', '++train.iteration=5', '+experiment=smoke', '-m', '++seed=1,2']
    >>> lenient(["scale=cpu"])
    ['+scale=cpu']
    """
    groups = _groups() | {"hydra"}
    has_experiment = any(argument.startswith("+experiment=") for argument in arguments)

    def forced(argument: str) -> str:
        if argument.startswith("scale=") and not has_experiment:
            return f"+{argument}"
        key = re.match(r"([A-Za-z_]\w*)(\.\w+)*=", argument)
        is_value = key is not None and key[1] != "hydra" and (key[2] is not None or key[1] not in groups)
        return f"++{argument}" if is_value else argument

    return [forced(argument) for argument in arguments]


def quoted(arguments: Sequence[str]) -> list[str]:
    """Quote names of files, so that they may have any characters; a ~ is the home folder, as a shell would have it.

    Commas part several names in a multirun, and belong to the name elsewhere.

    >>> quoted(["data.path=Flat (2), old", "seed=1"])
    ['data.path="Flat (2), old"', 'seed=1']
    >>> quoted(["-m", "data.path=Flat (2),old", "++init=null"])
    ['-m', 'data.path="Flat (2)","old"', '++init=null']
    """
    several = _is_multirun(arguments)

    def in_quotes(argument: str) -> str:
        found = FILES.fullmatch(argument)
        if found is None:
            return argument
        key, value = found.groups()
        is_list = several and not GRAMMAR.fullmatch(value)
        names = [name.strip() for name in ONE_OF_SEVERAL.findall(value)] if is_list else [value]
        return key + ",".join(map(_quoted, names))

    return [in_quotes(argument) for argument in arguments]


def _quoted(name: str) -> str:
    from hydra.core.override_parser.types import Quote, QuotedString  # not to recognise a finished run

    if GRAMMAR.fullmatch(name):
        return name
    return QuotedString(os.path.expanduser(name), Quote.double).with_quotes()


def _is_multirun(arguments: Sequence[str]) -> bool:
    """Whether a command line may start several runs, so that commas part values."""
    return any(re.match(r"-m$|--multirun$|\+*(experiment|sweep)=", text) for text in arguments)


def _groups() -> set[str]:
    folders = [path for path in (root() / "conf").iterdir() if path.is_dir()]
    return {path.stem for path in (*folders, *(root() / "conf" / "variants").iterdir())}


def conflict(arguments: Sequence[str]) -> str | None:
    """What is wrong with a command line that says two things at once, nothing, or takes a group for a value; None if
    none is.

    >>> conflict(["photographs", "seed=1"])
    'photographs is no setting: these are KEY=VALUE, e.g. data.path=photographs; see padgs-run --help'
    >>> conflict(["seed=1", "-m", "method=padgs", "++seed=2"])
    'seed is set twice, by seed=1 and ++seed=2; keep one of them'
    >>> conflict(["+sweep=tau,seeds"])
    '+sweep=tau,seeds: one sweep at a time, because each says itself what is swept'
    >>> conflict(["seed=0,1"])
    'seed=0,1 is a list of runs, which needs -m: padgs-run -m seed=0,1'
    >>> conflict(["protocol=null"])
    'protocol=null: protocol is a group of settings, chosen by name, e.g. protocol=both'
    >>> conflict(["+scene=roam360_bar", "launcher=slurm"])
    'launcher=slurm launches the jobs of a multirun; for this run: padgs-run -m +scene=roam360_bar launcher=slurm'
    >>> conflict(["+sweep=tau", "run.jobs=4"])
    'run.jobs=4 takes a launcher that runs several jobs at a time, e.g. launcher=local'
    """
    settings: dict[str, str] = {}
    before = ""
    for argument in arguments:
        key, equals, value = argument.partition("=")
        if not (equals or argument.startswith(("-", "~")) or before.startswith("-")):  # which may have a value
            return f"{argument} is no setting: these are KEY=VALUE, e.g. data.path={argument}; see padgs-run --help"
        before = argument
        if not equals or key.startswith("-"):
            continue
        key = key.lstrip("+~")
        if key in settings:
            return f"{key} is set twice, by {settings[key]} and {argument}; keep one of them"
        if key in ("experiment", "sweep") and ("," in value or "(" in value):
            return f"{argument}: one {key} at a time, because each says itself what is swept"
        if key in _groups() and re.fullmatch(r"null|~|true|false|[-+.\d]*", value, re.IGNORECASE):
            known = sorted(path.stem for path in (root() / "conf" / key).glob("*.yaml"))
            example = f", e.g. {key}={known[0]}" if known else ""
            return f"{argument}: {key} is a group of settings, chosen by name{example}"
        settings[key] = argument
    launcher = settings.get("launcher", "=none").partition("=")[2]
    jobs = settings.get("run.jobs", "=1").partition("=")[2]
    if not _is_multirun(arguments):
        for argument in settings.values():
            if not FILES.match(argument) and re.fullmatch(r"[^\[{('\"]*,.*", argument.partition("=")[2]):
                return f"{argument} is a list of runs, which needs -m: padgs-run -m {shlex.join(arguments)}"
        only_asks = any(argument.startswith("-") for argument in arguments)  # such as --cfg
        if launcher != "none" and not only_asks:
            command = f"padgs-run -m {shlex.join(arguments)}"
            return f"launcher={launcher} launches the jobs of a multirun; for this run: {command}"
    if jobs != "1" and launcher == "none" and "hydra/launcher" not in settings:
        return f"run.jobs={jobs} takes a launcher that runs several jobs at a time, e.g. launcher=local"
    return None


def expand(params: Mapping[str, Any], arguments: Sequence[str], loader: ConfigLoader) -> list[list[str]]:
    """The overrides of every job: all combinations of what is swept.

    Args:
        params: `hydra.sweeper.params`, key -> values as they would stand on a command line.
        arguments: of the command line; a key that is there replaces the same key of `params`.
        loader: knows the choices of groups, for `glob(...)`.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser  # not to recognise a finished run

    swept = lenient([f"{key}={values}" for key, values in params.items() if values is not None])
    choices: dict[str, list[str]] = {}
    for override in OverridesParser.create(config_loader=loader).parse_overrides([*swept, *arguments]):
        key = override.get_key_element()
        values = override.sweep_string_iterator() if override.is_sweep_override() else [None]
        texts = [override.get_value_element_as_str() if value is None else value for value in values]
        choices[key.lstrip("+")] = [key if key.startswith("~") else f"{key}={text}" for text in texts]
    return [list(job) for job in itertools.product(*choices.values())]
