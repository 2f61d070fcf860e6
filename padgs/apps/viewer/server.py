"""Web server of the viewer: viser, by default for this machine only, and only for browsers that have a token.

Imports no torch, so that browsers can load the page while torch and the runs are loading.
"""

from __future__ import annotations

import errno
import os
import secrets
import socket
import sys
import time
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from hashlib import sha256
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs

from padgs.checks import install_command, printable

if TYPE_CHECKING:
    from padgs.runs.load import LoadedRun

LOCAL, ALL_INTERFACES, PORT = "127.0.0.1", "0.0.0.0", 8080
LOOPBACK_NAMES = ("localhost", "127.0.0.1", "[::1]")
PORTS_TRIED = 1000
POLL_SECONDS = 0.5
MAX_BYTES = 1 << 20  # of a message
REFUSAL = "Open the whole address that padgs printed, with its token.\n"


@dataclass(frozen=True)
class Server:
    """A running server; `padgs.apps.viewer.pages.show_runs` adds the runs."""

    address: str  # URL with the token that lets browsers in
    viser: Any  # the `viser.ViserServer`
    is_local: bool  # whether it serves only this machine


def serve(
    load_runs: Callable[[], Sequence[LoadedRun]], *, host: str = LOCAL, port: int = PORT, browse: bool = False
) -> None:
    """Serve a page, print its address, and show runs until Ctrl-C; other arguments as in `start_server`.

    `load_runs` is called while browsers load the page; `browse`: also open the page in a browser, if it is local.
    """
    with start_server(host=host, port=port) as server:
        print(f"{server.address}  (Ctrl-C ends it)", flush=True)
        if browse and server.is_local:
            webbrowser.open(server.address)
        message = server.viser.gui.add_markdown("opening the run")
        runs = load_runs()
        from padgs.apps.viewer.pages import show_runs  # also slow

        message.remove()
        with show_runs(server, runs):
            while True:
                time.sleep(POLL_SECONDS)


@contextmanager
def start_server(*, host: str = LOCAL, port: int = PORT) -> Iterator[Server]:
    """Serve empty pages until the context ends, at the first free port from `port`; `LOCAL`: this machine only."""
    try:
        import viser
        from viser import _messages
    except ImportError as error:
        raise ValueError(f"the viewer needs viser: {install_command('view')}") from error
    token, local = secrets.token_urlsafe(24), host in (LOCAL, "localhost", "::1")
    port = free_port(host, port)
    with redirect_stdout(None), guard(token, is_local=local) as guarded:  # viser prints addresses even if not verbose
        server = viser.ViserServer(host=host, port=port, label="padgs", verbose=False)
    if not guarded:
        server.stop()
        raise ValueError(f"access to viser {viser.__version__} cannot be restricted; pip install viser==1.1.1")
    server.gui.configure_theme(dark_mode=True, show_share_button=False)  # sharing uses an external server
    for message in (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect):
        server._websock_server.unregister_handler(message)
    name = f"[{host}]" if ":" in host else "localhost" if local else host
    if host == ALL_INTERFACES:
        name = network_address()
    try:
        yield Server(f"http://{name}:{server.get_port()}/?token={token}", server, local)
    finally:
        with redirect_stdout(None):
            server.stop()


@contextmanager
def guard(token: str, *, is_local: bool) -> Iterator[list[int]]:
    """Guard the viser servers that start inside the context: only holders of the token are served.

    viser has no hook for this; it starts its server by `websockets.asyncio.server.serve`, which is replaced meanwhile.
    The token is expected in the address; a cookie keeps it for the websocket, whose address viser builds without it.
    `is_local`: also refuse all host names but those of this machine, against DNS rebinding. Yields the guarded ports.
    """
    from websockets.asyncio import server as websockets

    serve, ports = websockets.serve, []

    def guarded_serve(handler: Any, host: str, port: int, *, process_request: Any, **options: Any) -> Any:
        def process(connection: Any, request: Any) -> Any:
            try:
                response = process_request(connection, request)  # first, because it silences logs of refusals
            except Exception:  # of any path, such as one too long for a file
                response = connection.respond(HTTPStatus.NOT_FOUND, "")
            cookie = f"padgs-{sha256(token.encode()).hexdigest()[:12]}={token}"  # hosts in tunnels share localhost
            given = parse_qs(request.path.partition("?")[2]).get("token", [])
            cookies = [item.strip() for line in request.headers.get_all("Cookie") for item in line.split(";")]
            has_token = any(secrets.compare_digest(one.encode(), token.encode()) for one in given)
            has_cookie = any(secrets.compare_digest(one.encode(), cookie.encode()) for one in cookies)
            if not (has_token or has_cookie) or is_foreign(request.headers, is_local=is_local):
                return connection.respond(HTTPStatus.FORBIDDEN, REFUSAL)
            if response is not None:
                response.headers["X-Frame-Options"] = "DENY"
                if has_token:
                    response.headers["Set-Cookie"] = f"{cookie}; Path=/; HttpOnly; SameSite=Strict"
            return response

        ports.append(port)
        return serve(handler, host, port, **options | {"process_request": process, "max_size": MAX_BYTES})

    websockets.serve = guarded_serve
    try:
        yield ports
    finally:
        websockets.serve = serve


def is_foreign(headers: Any, *, is_local: bool) -> bool:
    """Return whether a request is for another host, or from a page of another origin."""
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    if len(hosts) != 1 or is_local and (hosts[0].rpartition(":")[0] or hosts[0]) not in LOOPBACK_NAMES:
        return True
    return not {*origins} <= {f"http://{hosts[0]}", f"https://{hosts[0]}"}


def free_port(host: str, first: int) -> int:
    """Return the first free port from `first` on; viser would wait for ever for one that cannot be had."""
    reason = f"the ports from {first} on are taken"
    for port in range(first, min(first + PORTS_TRIED, 65536)):
        try:
            family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
            socket.create_server(address, family=family).close()  # with SO_REUSEADDR
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


def has_screen() -> bool:
    """Return whether there is a graphical screen; without one, text browsers would take over the terminal."""
    windows = sys.platform == "darwin" or not {"DISPLAY", "WAYLAND_DISPLAY"}.isdisjoint(os.environ)
    return sys.stdout.isatty() and windows and "SSH_CONNECTION" not in os.environ


def wait_for_checkpoint(folder: str | Path) -> None:
    """Return when a run has a checkpoint, or will have none; a ValueError if no process trains it."""
    from padgs.runs.store import RunStore

    store, printed = RunStore(Path(folder)), False
    while not (store.has_checkpoint or store.has_result) and store.config.is_file():
        if not store.is_busy and not (store.has_checkpoint or store.has_result):  # it may have ended since
            raise ValueError(f"{folder} has no checkpoint, and no process trains it; start the same padgs-run again")
        if not printed:
            print(f"waiting for the first checkpoint of {printable(str(folder))}  (Ctrl-C ends it)", flush=True)
        printed = True
        time.sleep(POLL_SECONDS)
