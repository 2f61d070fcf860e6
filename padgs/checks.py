"""Checks of options, and registries; messages name the option, its value, and the rule or the known names.

A registry is a dict of name -> "package.module:attribute"; nothing is imported before it is asked for.
"""

import difflib
import sys
import types
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from importlib import import_module
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints


def check(options: object, rule: str, holds: Callable[[Any], bool], *names: str) -> None:
    """Raise a ValueError "NAME is VALUE; it must be RULE" if a rule does not hold for options of these names."""
    for name in names:
        value = getattr(options, name)
        if not holds(value):
            raise ValueError(f"{name} is {value}; it must be {rule}")


def check_known(options: object, **known: Collection[str]) -> None:
    """Raise a ValueError "unknown NAME VALUE; known: ..." for options that are none of the names known for them."""
    for name, names in known.items():
        value = getattr(options, name)
        if value not in names:
            raise ValueError(unknown(name, value, names))


def unknown(what: str, name: object, known: Collection[str], meant: Sequence[str] = ()) -> str:
    """Return an error message for a name that is none of the known ones, with those that may be meant.

    By default, that is the most similar one.

    >>> unknown("method", "padsg", ("padgs", "odgs"))
    "unknown method 'padsg'; known: padgs, odgs; did you mean padgs?"
    """
    close = meant or difflib.get_close_matches(str(name), known, 1)
    question = f"; did you mean {' or '.join(close)}?" if close else ""
    return f"unknown {what} {name!r}; known: {', '.join(known)}{question}"


def lookup(registry: Mapping[str, str], name: str, kind: str) -> Any:
    """Import and return the entry `name` of a registry of "backend", "method", or another kind.

    A ValueError lists the registered names, or says that an entry of another package fails, or ends the program, when
    it is imported.

    >>> lookup({"sqrt": "math:sqrt"}, "sqrt", "function")(9.0)
    3.0
    """
    if name not in registry:
        raise ValueError(f"unknown {kind} {name!r}; known: {', '.join(sorted(registry))}")
    module, _, attribute = registry[name].partition(":")
    try:
        return getattr(import_module(module), attribute)
    except (Exception, SystemExit) as error:
        if module.partition(".")[0] == "padgs":
            raise
        why = f"{type(error).__name__}: {error}"
        raise ValueError(f"{kind} {name} cannot be used: {registry[name]} of another package fails ({why})") from error


# Least and greatest numbers by the name of their key or its last word, and for all others by type. Beyond them a number
# means nothing, or asks for more than a machine has.
LIMITS: dict[object, tuple[int, int]] = {
    "train.iterations": (1, 10**8),
    "iterations": (0, 10**8),
    "seconds": (0, 10**8),
    **dict.fromkeys(("threads", "jobs"), (1, 1024)),
    "prefetch_threads": (0, 1024),
    **dict.fromkeys(("width", "height"), (0, 2**16)),
    **dict.fromkeys(("views", "samples", "objects", "rooms", "spokes", "nodes", "pass", "filter"), (0, 10**4)),
    **dict.fromkeys(("features", "hidden", "offsets", "components", "levels", "frequencies"), (0, 1024)),
    **dict.fromkeys(("bytes", "cap", "instances"), (0, 10**15)),
    "points": (0, 10**8),
    "gaussians": (1, 10**9),
    "seed": (0, 2**63 - 1),
    int: (0, 10**9),
    float: (-(10**6), 10**6),
}
MEASURED = ("timing", "counts")  # groups of results, whose numbers are at least 0
T = TypeVar("T")


class Key(str):
    """A dotted key of the configuration, shown without quotes."""

    __slots__ = ()
    __repr__ = str.__str__


class ConfigError(ValueError):
    """A configuration that cannot be used; the message names the key, its value and the known values."""


def typed(kind: type[T], values: Mapping[str, Any], where: str = "") -> T:
    """Return an instance of the dataclass `kind` with some of its fields set, nested dataclasses included.

    `where` is the key of the values in the whole configuration. A ConfigError names an unknown or missing key, or a
    value of another type.

    >>> from dataclasses import make_dataclass
    >>> typed(make_dataclass("Range", [("first", float), ("last", float, 1.0)]), {"first": 0})
    Range(first=0.0, last=1.0)
    """
    hints = _type_hints(kind)
    known = [field.name for field in fields(kind) if field.init]  # type: ignore[arg-type]
    for key in values:
        if key not in known:
            raise ConfigError(unknown("key", Key(_join(where, key)), [_join(where, other) for other in known]))
    required = [f.name for f in fields(kind) if f.default is MISSING and f.default_factory is MISSING]  # type: ignore[arg-type]
    missing = [name for name in required if name not in values]
    if missing:
        raise ConfigError(f"{_join(where, missing[0])} is not set")
    try:
        return kind(**{key: _value(hints[key], value, _join(where, key)) for key, value in values.items()})
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(f"{where}: {error}" if where else str(error)) from error


_type_hints = cache(get_type_hints)  # which compiles every annotation


def _refuse_beyond_limits(kinds: tuple[Any, ...], value: Any, where: str) -> None:
    numeric = {int, float} & {*kinds}
    if not numeric or not isinstance(value, (int, float)) or isinstance(value, bool):
        return
    if not -sys.float_info.max <= value <= sys.float_info.max:
        raise ConfigError(f"{where} is {value}; it must be finite")
    name = where.rpartition(".")[2].partition("[")[0]
    usual = LIMITS[float if float in numeric else int]
    low, high = LIMITS.get(where) or LIMITS.get(name) or LIMITS.get(name.rpartition("_")[2], usual)
    if where.partition(".")[0] in MEASURED:
        low, high = 0, sys.float_info.max
    if not low <= value <= high:
        raise ConfigError(f"{where} is {value}; it must be from {low} to {high}")


def _value(kind: Any, value: Any, where: str) -> Any:
    origin = get_origin(kind)
    _refuse_beyond_limits((kind, *get_args(kind)), value, where)
    if kind is Any:
        return value
    if origin in (Union, types.UnionType):
        return _first_fit(get_args(kind), value, where)
    if is_dataclass(kind) and isinstance(value, Mapping):
        return typed(kind, value, where)  # type: ignore[arg-type]
    if isinstance(origin, type) and issubclass(origin, Mapping) and isinstance(value, Mapping):
        item = get_args(kind)[1]
        return {str(key): _value(item, entry, _join(where, str(key))) for key, entry in value.items()}
    if origin is tuple and isinstance(value, Sequence) and not isinstance(value, str):
        return _tuple(get_args(kind), value, where)
    if kind is type(None) and value is None:
        return None
    if kind is bool and isinstance(value, bool):
        return value
    value = str(value).lower() if kind is str and isinstance(value, bool) else value  # a word that YAML reads as a bool
    if kind is str and isinstance(value, str):
        if any(0xD800 <= ord(character) < 0xE000 for character in value):
            raise ConfigError(f"{where} is {value!r}, which is not Unicode; rename the file or value")
        return value
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if is_number and (kind is float or kind is int and value == int(value)):
        return kind(value)
    raise ConfigError(f"{where} is {value!r}; it must be {_name(kind)}")


def _first_fit(kinds: tuple[Any, ...], value: Any, where: str) -> Any:
    if type(value) in kinds:
        return _value(type(value), value, where)
    for kind in kinds:
        try:
            return _value(kind, value, where)
        except ConfigError:
            if is_dataclass(kind) and isinstance(value, Mapping):
                raise  # the error inside the group says more
    raise ConfigError(f"{where} is {value!r}; it must be {' or '.join(_name(kind) for kind in kinds)}")


def _tuple(kinds: tuple[Any, ...], value: Sequence[Any], where: str) -> tuple[Any, ...]:
    if len(kinds) == 2 and kinds[1] is Ellipsis:
        kinds = (kinds[0],) * len(value)
    if len(kinds) != len(value):
        raise ConfigError(f"{where} is {list(value)}; it must have {len(kinds)} entries")
    return tuple(_value(kind, entry, f"{where}[{i}]") for i, (kind, entry) in enumerate(zip(kinds, value, strict=True)))


def _name(kind: Any) -> str:
    names = {type(None): "null", bool: "true or false", int: "a whole number", float: "a number", str: "a text"}
    origin = get_origin(kind)
    if is_dataclass(kind) or isinstance(origin, type) and issubclass(origin, Mapping):
        return "a group of keys"
    if origin is tuple:
        return "a list" if Ellipsis in get_args(kind) else f"a list of {len(get_args(kind))} values"
    return names.get(kind) or getattr(kind, "__name__", str(kind))


def _join(where: str, key: str) -> str:
    return f"{where}.{key}" if where else key


def install_command(extra: str) -> str:
    """Return the command that installs an extra of pyproject.toml for the running Python.

    >>> install_command("video").partition(" -m ")[2]
    "pip install 'padgs[video]'"
    """
    import shlex

    return shlex.join([sys.executable, "-m", "pip", "install", f"padgs[{extra}]"])


def printable(text: str, kept: str = "\n\t") -> str:
    r"""Return a text with escapes for control characters, also those of bidirectional text, and for lone surrogates.

    >>> printable("caf\u00e9 \x1b[2J \udce9 \u202e")
    'café \\x1b[2J \\udce9 \\u202e'
    """
    return "".join(c if c.isprintable() or c in kept else c.encode("unicode_escape").decode() for c in text)
