"""Access to the viewer: foreign pages, tokens, and values that the page does not offer."""

import hashlib
import http.client
import threading
import time
from contextlib import contextmanager, nullcontext
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import pytest
from support.chromium import in_chromium, visiting
from support.tiny_run import tiny_run

import padgs
from padgs.apps.viewer import server as servers
from padgs.apps.viewer.pages import show_runs
from padgs.apps.viewer.server import start_server

viser = pytest.importorskip("viser", reason="the extra `view` is not installed")
msgspec = pytest.importorskip("msgspec")
CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1, 0, 0, 0),
    "position": (0, 0, 0),
    "fov": 1,
    "near": 0.1,
    "far": 10,
    "image_height": 100,
    "image_width": 160,
    "look_at": (0, 0, 1),
    "up_direction": (0, 1, 0),
}
WEBSOCKET = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
WEBSOCKET |= {"Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Protocol": f"viser-v{viser.__version__}"}


def cookie_of(token: str) -> str:
    """Return the cookie that keeps a token; its name does not tell the token."""
    return f"padgs-{hashlib.sha256(token.encode()).hexdigest()[:12]}={token}"


def status(port: int, path: str, headers: dict[str, str]) -> int:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    connection.request("GET", path, headers=headers)
    found = connection.getresponse().status
    connection.close()
    return found


def until(condition) -> None:
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end, "never came true"
        time.sleep(0.02)


@pytest.fixture(scope="module", params=["127.0.0.1", "0.0.0.0"])
def server(request):
    with start_server(host=request.param, port=8480) as started:
        yield started


@pytest.mark.parametrize("websocket", [{}, WEBSOCKET, WEBSOCKET | {"Upgrade": "WebSocket"}])
def test_only_own_pages_with_the_token_are_served(server, websocket):
    port, token = server.viser.get_port(), server.address.partition("=")[2]
    ask, host, cookie = partial(status, port), f"localhost:{port}", {"Cookie": f"a=b; {cookie_of(token)}"}
    served = {200} if not websocket else {101}
    if websocket.get("Upgrade") == "WebSocket":
        served |= {200}  # viser takes only the lower case for a websocket
    own, right = {"Host": host} | websocket, f"/?token={token}"
    assert len(token) >= 32
    for headers in ({}, {"Origin": f"http://{host}"}, {"Host": "127.0.0.1:9"}, {"Host": "localhost"}):
        assert ask(right, own | headers) in served
    assert ask("/", own | cookie) in served
    for path in (
        "/",
        "/?token=",
        f"/?token={token[:-1]}",
        f"/?token=x{token}",
        "/?token=%ff",
        "/index.html",
        "//[",
        "/" + 4000 * "a",
    ):
        assert ask(path, own) == 403
    name = cookie_of(token).partition("=")[0]
    for forged in (f"{name}=", f"{name}x={token}", f"padgs-{port}={token}", token, ";;=;"):
        assert ask("/", own | {"Cookie": forged}) == 403
    for origin in ("null", "http://evil.example", f"http://{host}.evil.example", "http://localhost:1", ""):
        for path, headers in ((right, own), ("/", own | cookie)):
            assert ask(path, headers | {"Origin": origin}) == 403
    foreign = own | {"Host": f"evil.example:{port}"}
    assert ask("/", foreign) == 403, "nobody is served without a token"
    assert (ask(right, foreign) == 403) == server.is_local, "in a network this machine has any name"


def headers_of(server) -> http.client.HTTPMessage:
    """Return what a browser gets with the page."""
    connection = http.client.HTTPConnection("127.0.0.1", server.viser.get_port(), timeout=20)
    connection.request("GET", "/?" + server.address.partition("?")[2])
    headers = connection.getresponse().headers
    connection.close()
    return headers


def test_the_cookie_belongs_to_own_pages(server):
    headers = headers_of(server)
    parts = headers["Set-Cookie"].split("; ")
    assert parts[0] == cookie_of(server.address.partition("=")[2]) and {"HttpOnly", "SameSite=Strict"} <= {*parts}
    assert headers["X-Frame-Options"] == "DENY"


def test_servers_of_two_machines_at_one_port_have_cookies_of_their_own():
    """Tunnels bring both to localhost, where browsers keep one cookie of a name, whatever the port."""
    cookies = []
    for _ in range(2):
        with start_server(port=8486) as server:
            cookies.append(headers_of(server)["Set-Cookie"].partition("=")[0])
            assert server.viser.get_port() == 8486
    assert cookies[0] != cookies[1]


def test_tokens_differ_and_servers_without_a_guard_are_stopped(monkeypatch):
    with start_server(port=8490) as one, start_server(port=8490) as other:
        assert one.address.partition("=")[2] != other.address.partition("=")[2]
    monkeypatch.setattr(servers, "guard", lambda *_, **__: nullcontext([]))
    with pytest.raises(ValueError, match="cannot be restricted"), start_server(port=8495):
        raise AssertionError("it was started")
    with pytest.raises(OSError, match="refused"):
        status(8495, "/", {})


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return padgs.load_run(tiny_run(tmp_path_factory), device="cpu")


@contextmanager
def socket_of(server):
    """Connect a websocket as a page does; yields a function that sends a message."""
    from websockets.sync.client import connect
    from websockets.typing import Subprotocol

    address = server.address.replace("http", "ws")
    with connect(address, subprotocols=[Subprotocol(f"viser-v{viser.__version__}")], max_size=None) as socket:
        reading = threading.Thread(target=lambda: [None for _ in socket], daemon=True)
        reading.start()
        yield lambda message: socket.send(msgspec.msgpack.encode(message))


def test_forged_values_are_ignored(run):
    nan, inf = float("nan"), float("inf")
    with start_server(port=8500) as server, show_runs(server, [run]) as pages, socket_of(server) as send:
        send(CAMERA)
        until(lambda: pages)
        (page,) = pages.values()

        def update(control, value, answer: str) -> None:
            send({"type": "GuiUpdateMessage", "uuid": control._impl.uuid, "updates": {"value": value}})
            until(lambda: answer in page._summary.content)

        update(page._width, "512", " ms, 512x320")
        for control, forged, right in (
            (page._width, ("100000", 100000, nan, None, []), "512"),
            (page._camera, ("fisheye", {}), "perspective"),
            (page._layer, ("", [1]), "colours"),
            (page._run, ("side by side", "../run"), run.folder.name),
            (page._fov, (0, 1e9, 141), 75),
        ):
            for value in forged:
                update(control, value, "is not one of the page's choices")
                update(control, right, " ms")
        update(page._crop.is_on, True, " ms")
        low = page._crop.low.value
        for value in ((nan, 0, 0), (inf, 0, 0), (1e300, 0, 0)):
            update(page._crop.low, value, "numbers below")
            update(page._crop.low, low, " ms")
        for change in ({"position": (nan, 0, 0)}, {"position": (1e200, 0, 0)}, {"wxyz": (0, 0, 0, 0)}):
            send(CAMERA | change)
            until(lambda: "numbers below" in page._summary.content)
            send(CAMERA)
            until(lambda: " ms" in page._summary.content)
        page._renderers[0].nearest = lambda _: {}["<img src=x>"]
        update(page._layer, "error", "<b>KeyError</b>: '&lt;img src=x&gt;'")
        update(page._layer, "colours", " ms")
        for width in (10**9, -5, 2**62):
            send(CAMERA | {"image_width": width})
            until(lambda: " ms" in page._summary.content)
            assert max(page.state().width, page.state().height) == 512
        assert pages and not (run.folder / "stop").exists()


@pytest.mark.slow
@in_chromium
def test_pages_of_other_origins_reach_nothing_in_a_browser(tmp_path):
    (tmp_path / "index.html").write_text("<html>another page</html>")
    handler = partial(SimpleHTTPRequestHandler, directory=tmp_path)
    with start_server(port=8520) as server, ThreadingHTTPServer(("127.0.0.1", 0), handler) as other:
        threading.Thread(target=other.serve_forever, daemon=True).start()
        with visiting(server.address) as visit:
            visit.wait("document.querySelector('canvas') !== null")
            port = server.viser.get_port()
            tried = f"""address => new Promise(done => {{
                const socket = new WebSocket(address, ['viser-v{viser.__version__}']);
                socket.onmessage = () => done('open'); socket.onerror = () => done('refused');
            }})"""
            assert visit.page.evaluate(tried, f"ws://localhost:{port}") == "open", "the cookie of the page"
            token = server.address.partition("?")[2]
            visit.page.goto(f"http://localhost:{other.server_port}/")  # the same browser, and its cookies
            for address in (f"ws://localhost:{port}", f"ws://localhost:{port}/?{token}", f"ws://127.0.0.1:{port}"):
                assert visit.page.evaluate(tried, address) == "refused"
        other.shutdown()
