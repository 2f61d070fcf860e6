"""Web server of the viewer: viser, by default for this machine only.

Imports no torch, so that browsers can load the page while torch and the runs are loading.
"""

from __future__ import annotations

import errno
import secrets
import socket
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from padgs.apps.viewer.access import guard
from padgs.checks import install_command

LOCAL, PORT = "127.0.0.1", 8080
ALL_INTERFACES = "0.0.0.0"
PORTS_TRIED = 1000


@dataclass(frozen=True)
class Server:
    """A running server; `padgs.apps.viewer.pages.show_runs` adds the runs."""

    address: str  # URL with the token that lets browsers in
    viser: Any  # the `viser.ViserServer`
    is_local: bool  # whether it serves only this machine


@contextmanager
def start_server(*, host: str = LOCAL, port: int = PORT) -> Iterator[Server]:
    """Serve empty pages to any number of browsers, until the context ends.

    Args:
        host: `LOCAL` serves this machine only.
        port: the first port to try; the next free one is used.

    Raises:
        ValueError: the extra `view` is not installed.
        OSError: the address cannot be used.
    """
    viser, token, local = viser_module(), secrets.token_urlsafe(24), host in (LOCAL, "localhost", "::1")
    port = free_port(host, port)
    with redirect_stdout(None), guard(token, is_local=local) as guarded:  # viser prints addresses even if not verbose
        server = viser.ViserServer(host=host, port=port, label="padgs", verbose=False)
    if not guarded:
        server.stop()
        raise ValueError(f"access to viser {viser.__version__} cannot be restricted; pip install viser==1.1.1")
    server.gui.configure_theme(dark_mode=True, show_share_button=False)  # sharing uses an external server
    for message in (viser._messages.ShareUrlRequest, viser._messages.ShareUrlDisconnect):
        server._websock_server.unregister_handler(message)
    name = f"[{host}]" if ":" in host else "localhost" if local else host
    if host == ALL_INTERFACES:
        name = network_address()
    try:
        yield Server(f"http://{name}:{server.get_port()}/?token={token}", server, local)
    finally:
        with redirect_stdout(None):
            server.stop()


def free_port(host: str, first: int) -> int:
    """Return the first free port from `first` on; viser would wait for ever for one that cannot be had.

    Raises:
        OSError: the host is no address of this machine, or no port is free.
    """
    reason = f"the ports from {first} on are taken"
    for port in range(first, min(first + PORTS_TRIED, 65536)):
        try:
            family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
            with socket.socket(family, kind) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(address)
            return port
        except (OSError, UnicodeError) as error:
            if getattr(error, "errno", None) not in (errno.EADDRINUSE, errno.EACCES):
                reason = getattr(error, "strerror", None) or str(error)
                break
    raise OSError(
        f"cannot serve at {host}: {reason}; give --host an address of this machine or {ALL_INTERFACES}, and --port a "
        "free port"
    )


def network_address() -> str:
    """Return this machine's address in the network; localhost without a network."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # a reserved address; only looks up the route, sends nothing
        except OSError:
            return "localhost"
        return probe.getsockname()[0]


def viser_module() -> ModuleType:
    """Import viser.

    Raises:
        ValueError: it is not installed.
    """
    try:
        import viser
    except ImportError as error:
        raise ValueError(f"the viewer needs viser: {install_command('view')}") from error
    return viser
