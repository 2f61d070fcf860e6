"""Process."""

from __future__ import annotations

import os
import signal
import sys
import time
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import TYPE_CHECKING

from padgs import results
from padgs.apps.viewer.server import LOCAL, PORT, serving, viser_module
from padgs.runs import checkpoint
from padgs.runs.folder import RunFolder
from padgs.runs.lock import RunBusy, held

if TYPE_CHECKING:
    from padgs.runs.opened import OpenedRun

LOOKS = 0.5  # seconds between two looks at whether something is there, or still there
PATIENCE = 5.0  # seconds that a server has to end


def serve(
    opened: Callable[[], Sequence[OpenedRun]], *, host: str = LOCAL, port: int = PORT, browse: bool = False
) -> None:
    """Serve a page, say where, and show what `opened` returns, until the process that started this one, if any, ends.

    Args:
        opened: returns one run, or two to compare; called while browsers load the page, as both take seconds.
        host, port: as `padgs.apps.viewer.server.serving` takes them.
        browse: whether to open the page as well, where only this machine is served.

    Raises:
        ValueError, OSError, KeyboardInterrupt: as `serving` and `opened` do, and Ctrl-C.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # libraries take it for a crash otherwise
    with serving(host=host, port=port) as server:
        print(f"{server.address}  (Ctrl-C ends it)", flush=True)
        if browse and server.is_local:
            webbrowser.open(server.address)
        said = server.viser.gui.add_markdown("opening the run")
        runs = opened()
        from padgs.apps.viewer.pages import showing  # takes its time as well

        said.remove()
        with showing(server, runs):
            while is_wanted():
                time.sleep(LOOKS)


def has_screen() -> bool:
    """Whether this was started at a screen with windows: elsewhere browsers that draw text would take the terminal."""
    windows = sys.platform == "darwin" or not {"DISPLAY", "WAYLAND_DISPLAY"}.isdisjoint(os.environ)
    return sys.stdout.isatty() and windows and "SSH_CONNECTION" not in os.environ


def is_wanted() -> bool:
    """Whether the process that started this one is still there, if one of ours did."""
    return (parent := parent_process()) is None or parent.is_alive()


@contextmanager
def shown(folder: Path, data_path: str | None, device: str) -> Iterator[None]:
    """Serve a run in training on a device while the context lasts, from its first checkpoint on.

    Raises:
        ValueError: the extra `view` is not installed.
    """
    viser_module()
    process = get_context("spawn").Process(target=_show, args=(folder, data_path, device), daemon=True)
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the training, which ends the process
    try:
        process.start()  # inherits that
    finally:
        signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        process.terminate()
        process.join(PATIENCE)
        process.kill()  # whatever it still waits for
        process.join()


def _show(folder: Path, data_path: str | None, device: str) -> None:
    from padgs.apps.viewer.process import await_checkpoint
    from padgs.runs.opened import load_run

    with suppress(KeyboardInterrupt):
        await_checkpoint(folder)
        serve(lambda: [load_run(folder, data_path=data_path, device=device)])


def await_checkpoint(folder: str | Path) -> None:
    """Return when a run has its first checkpoint, or can have none any more: opening it then says what is wrong.

    Raises:
        ValueError: it was begun, but nobody trains it.
    """
    files, said, beside = RunFolder(Path(folder)), False, parent_process() is not None

    def decided() -> bool:
        return checkpoint.exists(files.checkpoint) or (files.path / results.FILE_NAME).exists()

    while not decided() and is_wanted():
        if not beside and not (files.path / results.CONFIG_NAME).is_file():
            return
        # Training beside which this process stands may not hold its lock yet; what ended just now is looked at again.
        if not beside and _is_left(files.path) and not decided():
            raise ValueError(f"{folder} has no checkpoint, and nobody trains it; start the same padgs-run again")
        if not said:
            print(f"waiting for the first checkpoint of {folder}  (Ctrl-C ends it)", flush=True)
        said = True
        time.sleep(LOOKS)


def _is_left(folder: Path) -> bool:
    """Whether nobody works on a run, as far as can be told."""
    try:
        with held(folder):
            return True
    except (RunBusy, OSError):  # a folder of somebody else, which cannot be locked from here
        return False
