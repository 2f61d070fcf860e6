"""Access to the viewer's web server: who may connect, and which messages of a page are read."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from secrets import compare_digest
from typing import Any
from urllib.parse import parse_qs

LOOPBACK_NAMES = ("localhost", "127.0.0.1", "[::1]")
# Messages that our pages send; viser also reads uploads and requests to publish the page.
MESSAGES = {"ViewerCameraMessage", "GuiUpdateMessage", "SceneNodeClickMessage"}
MAX_BYTES = 1 << 20  # of a message
REFUSAL = "Open the whole address that padgs printed, with its token.\n"


@contextmanager
def guard(token: str, *, is_local: bool) -> Iterator[list[int]]:
    """Guard the viser servers that start inside the context: only holders of the token are served.

    viser has no hook for this; it starts its server by `websockets.asyncio.server.serve`, which is replaced meanwhile.

    Args:
        token: expected in the address; a cookie keeps it for the websocket, whose address viser builds without it.
        is_local: also refuse all host names but those of this machine, against DNS rebinding.

    Returns:
        The ports of guarded servers.
    """
    from websockets.asyncio import server as websockets

    serve, ports = websockets.serve, []

    class Connection(websockets.ServerConnection):
        async def recv(self, decode: bool | None = None) -> Any:
            while not is_known(data := await super().recv(decode)):
                pass
            return data

    def guarded_serve(handler: Any, host: str, port: int, *, process_request: Any, **options: Any) -> Any:
        def process(connection: Any, request: Any) -> Any:
            asyncio.get_running_loop().set_exception_handler(_report)
            try:
                response = process_request(connection, request)  # first, because it silences logs of refusals
            except Exception:  # of any path, such as one too long for a file
                response = connection.respond(HTTPStatus.NOT_FOUND, "")
            cookie = f"padgs-{connection.local_address[1]}={token}"
            given = parse_qs(request.path.partition("?")[2]).get("token", [])
            cookies = [item.strip() for line in request.headers.get_all("Cookie") for item in line.split(";")]
            has_token = any(compare_digest(one.encode(), token.encode()) for one in given)
            has_cookie = any(compare_digest(one.encode(), cookie.encode()) for one in cookies)
            if not (has_token or has_cookie) or is_foreign(request.headers, is_local=is_local):
                return connection.respond(HTTPStatus.FORBIDDEN, REFUSAL)
            if response is not None:
                response.headers["X-Frame-Options"] = "DENY"
                if has_token:
                    response.headers["Set-Cookie"] = f"{cookie}; Path=/; HttpOnly; SameSite=Strict"
            return response

        ports.append(port)
        options |= {"process_request": process, "create_connection": Connection, "max_size": MAX_BYTES}
        return serve(handler, host, port, **options)

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


def is_known(data: object) -> bool:
    """Return whether data of a websocket is a message that our pages send."""
    from viser._messages import Message

    try:
        message = Message.deserialize(data) if isinstance(data, bytes) else None
        updates = getattr(message, "updates", {"value": None})
        return type(message).__name__ in MESSAGES and updates.keys() == {"value"}
    except Exception:  # whatever may be sent
        return False


def _report(_: object, context: dict[str, Any]) -> None:
    """Print an error of viser's event loop in a line: values of a wrong type must not fill the terminal."""
    print(f"the viewer ignored a message: {str(context.get('exception') or context['message'])[:200]!r}", flush=True)
