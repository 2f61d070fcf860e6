"""Translate command lines into overrides for Hydra, and expand a sweep into the overrides of its jobs."""

import importlib.util
import itertools
import math
import os
import re
import shlex
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString

from padgs.checks import install_command, unknown

SHOW = "--cfg"
OPTIONS = ("-m", "--multirun", SHOW, "--help", "-h", "--version")
HELP = "see padgs-run --help"
NEEDED = ("render", "train", "protocol", "data", "budget", "method")  # without these groups, defaults of classes count
PLUGINS = {  # choice of conf/launcher -> module of its plugin, extra of pyproject.toml
    "local": ("hydra_plugins.hydra_joblib_launcher", "launchers"),
    "slurm": ("hydra_plugins.hydra_submitit_launcher", "launchers"),
    "submitit": ("hydra_plugins.hydra_submitit_launcher", "launchers"),
    "ray": ("hydra_plugins.hydra_ray_launcher", "ray"),
}
MOST_JOBS = 10_000
# Keys that name files, and their values; values in Hydra's grammar: nothing, null, quotes, dictionaries, calls;
# one name of a list.
FILES = re.compile(r"(\+*(?:data\.(?:path|images|points|mask|disk_cache)|run\.folder|init)=)(.*)", re.DOTALL)
GRAMMAR = re.compile(r"|null|(['\"]).*\1|\{.*\}|(choice|glob|shuffle|sort|tag)\(.*\)", re.DOTALL)
ONE_OF_SEVERAL = re.compile(r"\"[^\"]*\"|'[^']*'|[^,]+")


def root() -> Path:
    """Return the folder of `conf/` and `sweeps/`: the package if it is installed, else the checkout."""
    package = Path(__file__).resolve().parent.parent
    return package if (package / "conf").is_dir() else package.parent


def lenient(arguments: Sequence[str]) -> list[str]:
    """Force unknown keys past Hydra, so that `config_from_values` refuses them and lists the known ones.

    Experiments choose a `scale`; without an experiment that group is added.

    >>> lenient(["method=padgs", "train.iteration=5", "+experiment=smoke", "-m", "seed=1,2"])
    ['method=padgs', '++train.iteration=5', '+experiment=smoke', '-m', '++seed=1,2']
    >>> lenient(["scale=cpu", "scene_set=bar_cpu"])
    ['+scale=cpu', 'scene_set=bar_cpu']
    """
    groups = _groups()
    has_experiment = any(argument.startswith("+experiment=") for argument in arguments)

    def forced(argument: str) -> str:
        if argument.startswith("scale=") and not has_experiment:
            return f"+{argument}"
        key = re.match(r"([A-Za-z_]\w*)(\.\w+)*=", argument)
        is_value = key is not None and key[1] != "hydra" and (key[2] is not None or key[1] not in groups)
        return f"++{argument}" if is_value else argument

    return [forced(argument) for argument in arguments]


def quoted(arguments: Sequence[str]) -> list[str]:
    """Quote names of files, so that they may have any characters; a leading ~ is the home folder, as in a shell.

    In a multirun, commas separate names; elsewhere they belong to the name.

    >>> quoted(["data.path=Flat (2), old", "seed=1"])
    ['data.path="Flat (2), old"', 'seed=1']
    >>> quoted(["-m", "data.path=Flat (2),old", "++init=null"])
    ['-m', 'data.path="Flat (2)","old"', '++init=null']
    """
    several = is_multirun(arguments)

    def in_quotes(argument: str) -> str:
        if not (found := FILES.fullmatch(argument)):
            return argument
        key, value = found.groups()
        is_list = several and not GRAMMAR.fullmatch(value)
        names = [name.strip() for name in ONE_OF_SEVERAL.findall(value)] if is_list else [value]
        return key + ",".join(map(_quoted, names))

    return [in_quotes(argument) for argument in arguments]


def _quoted(name: str) -> str:
    return name if GRAMMAR.fullmatch(name) else QuotedString(os.path.expanduser(name), Quote.double).with_quotes()


def is_multirun(arguments: Sequence[str]) -> bool:
    """Return whether a command line may start several runs, so that commas separate values."""
    return any(re.match(r"-m$|--multirun$|\+*(experiment|sweep)=", text) for text in arguments)


def _groups() -> set[str]:
    folders = [path for path in (root() / "conf").iterdir() if path.is_dir()]
    tables = (root() / "conf" / "variants").iterdir()
    return {"sweep", "scene_set", "method_set", "length_set", *(path.stem for path in (*folders, *tables))}


def problem(arguments: Sequence[str]) -> str | None:
    """Return an error message for a command line that sets something twice or sets no key; None if it is fine.

    >>> problem(["photographs", "seed=1"])
    'photographs is no setting: these are KEY=VALUE, e.g. data.path=photographs; see padgs-run --help'
    >>> problem(["seed=1", "-m", "method=padgs", "++seed=2"])
    'seed is set twice, by seed=1 and ++seed=2; keep one of them'
    >>> problem(["method=[a]"])
    'method=[a]: method is a group of settings, chosen by name; see padgs-run --help'
    >>> problem(["+sweep=tau,seeds"])
    '+sweep=tau,seeds: one sweep at a time, because each names what it sweeps'
    >>> problem(["+scene=roam360_bar", "launcher=slurm"])
    'launcher=slurm launches the jobs of a multirun; for this run: padgs-run -m +scene=roam360_bar launcher=slurm'
    >>> problem(["~train", "train.iterations=100"])
    '~train: every run has train settings; choose others by train=NAME, or change a key of them'
    >>> problem(["+sweep=tau", "run.jobs=4"])
    'run.jobs=4 is for launcher=local or submitit; Slurm reads hydra.launcher.array_parallelism'
    """
    settings: dict[str, str] = {}
    if SHOW in arguments[-1:]:
        return f"{SHOW} needs the part of the configuration to print, e.g. {SHOW} job"
    for before, argument in zip(["", *arguments], arguments, strict=False):
        key, equals, value = argument.partition("=")
        if argument.startswith("-") and argument not in OPTIONS:
            return unknown("option", argument, OPTIONS)
        if argument in OPTIONS or before == SHOW:
            continue
        key = key.lstrip("+~")
        if not key or not (equals or argument.startswith("~")):
            return f"{argument} is no setting: these are KEY=VALUE, e.g. data.path={value or argument}; {HELP}"
        if argument.startswith("~") and key in NEEDED:
            return f"{argument}: every run has {key} settings; choose others by {key}=NAME, or change a key of them"
        if not equals:
            continue
        if key in settings:
            return f"{key} is set twice, by {settings[key]} and {argument}; keep one of them"
        if key in ("experiment", "sweep") and ("," in value or "(" in value):
            return f"{argument}: one {key} at a time, because each names what it sweeps"
        if key in _groups() and re.fullmatch(r"null|~|true|false|[-+.\d]*|[\[{].*", value, re.IGNORECASE):
            return f"{argument}: {key} is a group of settings, chosen by name; {HELP}"
        settings[key] = argument
    launcher = settings.get("launcher", "=none").partition("=")[2]
    if launcher != "none" and not is_multirun(arguments) and SHOW not in arguments:
        command = f"padgs-run -m {shlex.join(arguments)}"
        return f"launcher={launcher} launches the jobs of a multirun; for this run: {command}"
    jobs = settings.get("run.jobs", "=1").partition("=")[2]
    if jobs != "1" and launcher in ("none", "slurm", "ray") and "hydra/launcher" not in settings:
        return f"run.jobs={jobs} is for launcher=local or submitit; Slurm reads hydra.launcher.array_parallelism"
    return None


def missing_plugin(arguments: Sequence[str]) -> str | None:
    """Return the command that installs the plugin of the launcher in a command line; None if nothing is missing.

    >>> missing_plugin(["method=padgs", "seed=0,1"])
    """
    for name in (argument.partition("=")[2] for argument in arguments if argument.startswith("launcher=")):
        module, extra = PLUGINS.get(name, ("padgs", ""))
        with suppress(ModuleNotFoundError):  # there is no plugin at all
            if importlib.util.find_spec(module):
                continue
        return f"launcher={name} needs {module.partition('.')[2]}: {install_command(extra)}"
    return None


def expand(params: Mapping[str, Any], arguments: Sequence[str], loader: ConfigLoader) -> list[list[str]]:
    """Return the overrides of each job: all combinations of the swept values, at most `MOST_JOBS`.

    `params` is `hydra.sweeper.params`, key -> values in the grammar of the command line, whose arguments replace the
    same keys. The loader lists the choices of groups for `glob(...)`.
    """
    swept = lenient([f"{key}={values}" for key, values in params.items() if values is not None])
    choices: dict[str, list[str]] = {}
    for override in OverridesParser.create(config_loader=loader).parse_overrides([*swept, *arguments]):
        key = override.get_key_element()
        values = override.sweep_string_iterator() if override.is_sweep_override() else [None]
        first = list(itertools.islice(values, MOST_JOBS + 1))  # range(1,1e9) would take all memory
        if not first:
            raise ValueError(f"{override.input_line} has no value; correct the name or the range")
        if key.lstrip("+") == "run.folder" and len(first) > 1:
            raise ValueError(f"{override.input_line} has several values; use one command for each folder")
        texts = [override.get_value_element_as_str() if value is None else value for value in first]
        choices[key.lstrip("+")] = [key if key.startswith("~") else f"{key}={text}" for text in dict.fromkeys(texts)]
    if len(choices.get("scene", ())) > 1 and "data.path" in choices:
        way_out = "leave out one, or add ~scene_set to an experiment that lists scenes"
        raise ValueError(f"data.path names one folder, beside {len(choices['scene'])} scenes; {way_out}")
    if math.prod(map(len, choices.values())) > MOST_JOBS:
        raise ValueError(f"the sweep has more than {MOST_JOBS} jobs; sweep fewer values, or use several commands")
    return [list(job) for job in itertools.product(*choices.values())]
