"""Split of the views into training and test views: by list files, or every k-th view."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from unicodedata import normalize

from padgs.data.capture import EVERY, DataError, first_of, listed
from padgs.data.images import EXTENSIONS, read_bytes

MAX_NAME_BYTES = 255  # of a file name
UTF_16 = (b"\xff\xfe", b"\xfe\xff")  # first bytes of what Windows calls Unicode
Names = Sequence[str]
LISTS = {"train": "train.txt", "test": "test.txt"}


@dataclass(frozen=True)
class Split:
    """Ascending indices into the frames, and notes about the decision."""

    train: tuple[int, ...]
    test: tuple[int, ...]
    notes: tuple[str, ...] = ()


def split_frames(
    names: Names,
    *folders: Path,
    mode: str = "auto",
    every: int = EVERY,
    stated: Mapping[str, tuple[str, ...]] | None = None,
    unposed: Names = (),
    left_out: Names = (),
) -> Split:
    """Decide for each frame whether it is a training view, a test view, or unused.

    `names` are those of frames, with extension and sorted; the first of `folders` that has `train.txt` or `test.txt`
    counts: one name a line, with or without extension. `mode` is files; every (views 0, k, 2k, ... are test views, k is
    `every`); all (no test views); or auto: the lists that the format has `stated`, else files if there is a list, else
    every. Lists may hold names that are `left_out`. A DataError says that a list holds unknown, ambiguous or `unposed`
    names, that lists overlap, or that a side is empty.
    """
    if mode == "all":
        _refuse_every(every, "data.split=all")
        return Split(tuple(range(len(names))), (), ("split: every view is a training view (data.split=all)",))
    places = [place for folder in folders for place in (folder, folder / "sparse" / "0")]  # as in the released 3DGS
    found = {side: [file for place in places if (file := first_of(place, (name,)))] for side, name in LISTS.items()}
    files = {side: some[0] for side, some in found.items() if some}
    lists = dict(stated or {}) if mode == "auto" else {}
    origin = "the split of the data set"
    if lists and files:
        origin += f"; {' and '.join(file.name for file in files.values())} not used: data.split=files uses them"
    which = {side: f"{side} list of the data set" for side in lists}
    if not lists and mode != "every":
        lists = {side: read_list(file) for side, file in files.items()}
        which = {side: f"{side} list {file}" for side, file in files.items()}
        origin = " and ".join(file.name for file in files.values())
    if not lists:
        if mode == "files":
            raise DataError(f"data.split=files: {folders[0]} holds no train.txt, no test.txt; write one, or use every")
        return _every(names, every, mode)
    _refuse_every(every, origin.partition(";")[0])
    chosen = {side: _resolve(lines, names, which[side], unposed, left_out) for side, lines in lists.items()}
    notes = [f"split: {origin}"]
    for side, other in (("train", "test"), ("test", "train")):
        if side not in chosen:
            chosen[side] = set(range(len(names))) - chosen[other]
            notes.append(f"there is no {side} list; all views missing from the {other} list are used")
    if both := chosen["train"] & chosen["test"]:
        overlap = listed(names[i] for i in sorted(both))
        raise DataError(f"train and test list overlap: {overlap}; a view is one or the other")
    for side in ("train", "test"):
        if not chosen[side]:
            ways = "name at least one view, or set data.split to every, or to all for no test views"
            raise DataError(f"the {side} split is empty; {ways}")
    if unused := len(names) - len(chosen["train"]) - len(chosen["test"]):
        notes.append(f"{unused} posed views are in neither list and are not used")
    return Split(tuple(sorted(chosen["train"])), tuple(sorted(chosen["test"])), tuple(notes))


def _refuse_every(every: int, decides: str) -> None:
    if every != EVERY:
        raise DataError(
            f"data.test_every={every} changes nothing beside {decides}; leave it out, or set data.split=every"
        )


def read_list(path: Path) -> tuple[str, ...]:
    """Read the names in a list file: one a line, blank lines skipped, any line ending, optional byte-order mark."""
    return tuple(check_name(line.strip(), str(path)) for line in read_lines(path) if line.strip())


def read_lines(path: Path, errors: str = "strict") -> list[str]:
    """Read the lines of a text file in UTF-8, or UTF-16 with its mark; `errors` is that of `bytes.decode`."""
    data = read_bytes(path, empty=True)
    try:
        text = data.decode("utf-16" if data.startswith(UTF_16) else "utf-8-sig", errors)
    except UnicodeDecodeError as error:
        raise DataError(f"{path} cannot be read as UTF-8 text ({error}); save it as UTF-8") from error
    # Not str.splitlines, which also ends lines at characters that names may have.
    return re.split(r"\r\n?|\n", text.removesuffix("\n")) if text else []


def is_inside(name: str) -> bool:
    """Return whether a name is relative and stays inside its folder: names must not reach files elsewhere."""
    parts = PurePosixPath(name.replace("\\", "/"))
    absolute = parts.is_absolute() or PureWindowsPath(name).drive
    return not absolute and ".." not in parts.parts and bool(parts.name) and "\0" not in name


def check_name(name: str, where: str) -> str:
    """Return a name that a file system can hold; a DataError if it is not Unicode or too long, `where` says whose."""
    if any(0xD800 <= ord(character) < 0xE000 for character in name):
        raise DataError(f"{where} names {name!r}, which is not Unicode; rename the file, and export again")
    if any(len(part.encode()) > MAX_NAME_BYTES for part in PurePosixPath(name.replace("\\", "/")).parts):
        raise DataError(f"{where} names {name[:60]!r}...; file names have at most {MAX_NAME_BYTES} bytes: rename it")
    return name


def spellings(name: str) -> Iterator[str]:
    """Yield what a stated name may mean: itself, then its ends, each with and without extension; "/" between folders.

    >>> list(spellings("C:\\\\scan\\\\a.jpg"))
    ['C:/scan/a.jpg', 'C:/scan/a', 'scan/a.jpg', 'scan/a', 'a.jpg', 'a']
    """
    parts = [part for part in normalize("NFC", name).replace("\\", "/").split("/") if part not in ("", ".")]
    for start in range(len(parts)):
        end = "/".join(parts[start:])
        yield end
        if end.lower().endswith(EXTENSIONS):
            yield end.rpartition(".")[0]


def _keys(name: str) -> list[str]:
    """Return `spellings` in one case and without outer spaces, which lists drop; no two names differ in these alone."""
    return [key.strip() for key in spellings(name.casefold())]


def _every(names: Names, every: int, mode: str) -> Split:
    test = tuple(range(0, len(names), every))
    if not (train := tuple(i for i in range(len(names)) if i % every)):
        raise DataError(f"{len(names)} posed view(s) cannot be split; at least 2 are needed: set data.split=all")
    why = "no train.txt or test.txt" if mode == "auto" else "data.split=every"
    return Split(train, test, (f"split: every {every}th view is a test view ({why})",))


def _resolve(lines: Names, names: Names, which: str, unposed: Names, left_out: Names) -> set[int]:
    meant: dict[str, set[int]] = {}
    known, posed = (*names, *left_out, *unposed), len(names) + len(left_out)
    folders = [_keys(name)[0].count("/") for name in known]
    for i, name in enumerate(known):
        for key in _keys(name):
            meant.setdefault(key, set()).add(i)
    meant |= {_keys(name)[0]: {i} for i, name in enumerate(known)}

    def found_in(line: str, pool: range) -> set[int]:
        """Return the names of which the line is an end, or which are an end of it; not those that only end alike."""
        keys = [(key, key.count("/")) for key in _keys(line)]
        each = ({i for i in meant.get(key, ()) if i in pool and n in (keys[0][1], folders[i])} for key, n in keys)
        return next(filter(None, each), set())

    chosen: set[int] = set()
    absent: list[str] = []
    for line in lines:
        found = found_in(line, range(posed))
        if len(found) > 1:
            matches = listed(known[i] for i in sorted(found))
            raise DataError(f"the {which} names {line!r}, which matches {matches}; be specific")
        if not found:
            absent.append(line)
        chosen |= found
    if without := [line for line in absent if found_in(line, range(posed, len(known)))]:
        raise DataError(f"the {which} names images that have no pose: {listed(without)}; remove them from the list")
    if absent:
        rule = f"a line is one name, and the data set has {listed(names)}"
        raise DataError(f"the {which} names images that do not exist: {listed(map(repr, absent))}; {rule}")
    return {i for i in chosen if i < len(names)}
