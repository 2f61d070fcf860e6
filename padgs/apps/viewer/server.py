"""The server that pages come from: viser, on this machine alone unless another address is given.

Imports nothing of torch: browsers load their page while that, and the runs, are still being loaded.
"""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from padgs.extras import installing

LOCAL, PORT = "127.0.0.1", 8080
EVERYWHERE = "0.0.0.0"  # any address of this machine


@dataclass(frozen=True)
class Serving:
    """A server at work; `padgs.apps.viewer.pages.showing` gives it something to show."""

    address: str  # for a browser
    viser: Any  # the `viser.ViserServer`
    is_local: bool  # whether only this machine is served


@contextmanager
def serving(*, host: str = LOCAL, port: int = PORT) -> Iterator[Serving]:
    """Serve empty pages to any number of browsers, until the context ends.

    Args:
        host: `LOCAL` is this machine alone.
        port: the first to try; the next free one is taken.

    Raises:
        ValueError: the extra `view` is not installed.
        OSError: the address cannot be served.
    """
    viser = viser_module()
    with redirect_stdout(None):  # it draws a box around addresses, whatever `verbose` says
        server = viser.ViserServer(host=host, port=port, label="padgs", verbose=False)
    server.gui.configure_theme(dark_mode=True, show_share_button=False)  # sharing would go through a stranger's server
    local = host in (LOCAL, "localhost")
    name = "localhost" if local else own_address() if host == EVERYWHERE else host
    try:
        yield Serving(f"http://{name}:{server.get_port()}", server, local)
    finally:
        with redirect_stdout(None):
            server.stop()


def own_address() -> str:
    """What others in the network call this machine; localhost where there is no network."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as way:
        try:
            way.connect(("192.0.2.1", 9))  # no machine has this address: the way out is looked up, nothing is sent
        except OSError:
            return "localhost"
        return way.getsockname()[0]


def viser_module() -> ModuleType:
    """The package that serves.

    Raises:
        ValueError: it is not installed.
    """
    try:
        import viser
    except ImportError as error:
        raise ValueError(f"the viewer needs viser: {installing('view')}") from error
    return viser
