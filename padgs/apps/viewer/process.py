"""Processes of the viewer: `padgs view`, or a child process of a run in training, which does not share its memory."""

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

from padgs.apps.viewer.server import LOCAL, PORT, start_server, viser_module
from padgs.checks import printable
from padgs.runs.interrupt import answer_signals

if TYPE_CHECKING:
    from padgs.runs.load import LoadedRun

POLL_SECONDS = 0.5
STOP_SECONDS = 5.0  # until a server that does not stop is killed


def serve(
    load_runs: Callable[[], Sequence[LoadedRun]], *, host: str = LOCAL, port: int = PORT, browse: bool = False
) -> None:
    """Serve a page, print its address, and show runs until Ctrl-C, or until the parent process ends.

    Args:
        load_runs: returns one run, or two to compare; called while browsers load the page, because both take seconds.
        host, port: as in `padgs.apps.viewer.server.start_server`.
        browse: also open the page in a browser, if it is local.

    Raises:
        ValueError, OSError: from `start_server` or `load_runs`.
        KeyboardInterrupt: on Ctrl-C.
    """
    answer_signals()  # also in a child process
    with start_server(host=host, port=port) as server:
        print(f"{server.address}  (Ctrl-C ends it)", flush=True)
        if browse and server.is_local:
            webbrowser.open(server.address)
        message = server.viser.gui.add_markdown("opening the run")
        runs = load_runs()
        from padgs.apps.viewer.pages import show_runs  # also slow

        message.remove()
        with show_runs(server, runs):
            while parent_is_alive():
                time.sleep(POLL_SECONDS)


def has_screen() -> bool:
    """Return whether there is a graphical screen; without one, text browsers would take over the terminal."""
    windows = sys.platform == "darwin" or not {"DISPLAY", "WAYLAND_DISPLAY"}.isdisjoint(os.environ)
    return sys.stdout.isatty() and windows and "SSH_CONNECTION" not in os.environ


def parent_is_alive() -> bool:
    """Return whether the parent process is alive; True for a main process."""
    return (parent := parent_process()) is None or parent.is_alive()


@contextmanager
def serve_training(folder: Path, data_path: str | None, device: str) -> Iterator[None]:
    """Serve a run in training from a child process while the context lasts, from the first checkpoint on.

    Raises:
        ValueError: the extra `view` is not installed.
    """
    viser_module()
    process = get_context("spawn").Process(target=_show, args=(folder, data_path, device), daemon=True)
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the training, which ends the child
    try:
        process.start()  # inherits the handler
    finally:
        signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        process.terminate()
        process.join(STOP_SECONDS)
        process.kill()
        process.join()


def _show(folder: Path, data_path: str | None, device: str) -> None:
    from padgs.runs.load import load_run

    with suppress(KeyboardInterrupt):
        wait_for_checkpoint(folder)
        serve(lambda: [load_run(folder, data_path=data_path, device=device)])


def wait_for_checkpoint(folder: str | Path) -> None:
    """Return when a run has a checkpoint, or will have none; opening it then reports the reason.

    Raises:
        ValueError: the run was started, but no process trains it.
    """
    from padgs.runs.store import RunStore

    files, printed, is_child = RunStore(Path(folder)), False, parent_process() is not None

    def is_decided() -> bool:
        return files.has_checkpoint or files.has_result

    while not is_decided() and parent_is_alive():
        if not is_child and not files.config.is_file():
            return
        # A parent that trains may not hold the lock yet; a run may have ended since the first test.
        if not is_child and not files.is_busy and not is_decided():
            raise ValueError(f"{folder} has no checkpoint, and no process trains it; start the same padgs-run again")
        if not printed:
            print(f"waiting for the first checkpoint of {printable(str(folder))}  (Ctrl-C ends it)", flush=True)
        printed = True
        time.sleep(POLL_SECONDS)
