"""Pages in a real browser, and what may go wrong before there is one."""

import socket
import sys
import time
from urllib.request import urlopen

import pytest
from support.chromium import in_chromium, visiting
from support.tiny_run import tiny_run
from typer.testing import CliRunner

import padgs
from padgs.apps.viewer.pages import BOTH, crop_box, show_runs
from padgs.apps.viewer.server import start_server
from padgs.checks import install_command
from padgs.cli.commands import app
from padgs.scene import View

try:
    import viser
except ImportError:
    viser = None
WITH_VISER = pytest.mark.skipif(viser is None, reason="the extra `view` is not installed")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return padgs.load_run(tiny_run(tmp_path_factory), device="cpu")


def until(condition) -> None:
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end, "never came true"
        time.sleep(0.05)


@WITH_VISER
def test_the_page_is_local_and_ends(run):
    with start_server(port=8400) as server, show_runs(server, [run]):
        assert server.is_local and server.address.startswith("http://localhost:")
        assert b"<html" in urlopen(server.address, timeout=20).read()[:500]
    with pytest.raises(OSError, match="refused"):
        urlopen(server.address, timeout=5)


@WITH_VISER
def test_network_pages_have_a_network_address():
    with start_server(host="0.0.0.0", port=8410) as server:
        assert not server.is_local and "0.0.0.0" not in server.address
        assert b"<html" in urlopen(server.address, timeout=20).read()[:500]


@WITH_VISER
@pytest.mark.parametrize("host", ["999.9.9.9", "8.8.8.8", "[::1]", "x" * 300])
def test_hosts_that_cannot_be_served_are_refused(host):
    with pytest.raises(OSError, match="cannot serve at .* give --host an address of this machine"):  # noqa: SIM117
        with start_server(host=host):
            raise AssertionError("it was started")


@WITH_VISER
def test_the_next_free_port_is_used():
    with socket.create_server(("127.0.0.1", 65534)), start_server(port=65534) as server:
        assert server.viser.get_port() == 65535
        with pytest.raises(OSError, match="the ports from 65534 on are taken"), start_server(port=65534):
            raise AssertionError("it was started")


@WITH_VISER
@pytest.mark.slow
@in_chromium
def test_a_browser_shows_all_controls(run, tmp_path):
    """Set controls from Python, and observe the page."""
    with start_server(port=8420) as server, visiting(server.address) as visit, show_runs(server, [run, run]) as pages:
        until(lambda: pages)
        (page,) = pages.values()
        page._width.value = "512"
        middle = run.scene.train[len(run.scene.train) // 2]
        until(lambda: (View("", page.state().cam_from_world, 1, 1).center - middle.center).norm() < 1e-4)

        def shows(*texts: str) -> None:
            until(lambda: all(text in page._summary.content for text in ("51", *texts)))
            words = page._summary.content.split()[0]  # how many Gaussians
            visit.wait(f"document.body.innerText.includes({words!r})")

        shows("gaussians", " ms")
        page._run.value = BOTH
        until(lambda: len(page.state().renderers) == 2)
        shows()
        page._run.value = next(iter(page._by_name))
        page._layer.value = "error"
        shows("error of")
        page._layer.value, page._camera.value = "depth", "panorama"
        page._frusta_shown.value = page._crop.is_on.value = True
        shows()
        view = run.scene.test[0]
        page.go_to(view)
        until(lambda: abs(page.state().cam_from_world - view.cam_from_world).max() < 1e-6)
        page._layer.value, page._camera.value = "colours", "perspective"
        page._fov.value = 60
        until(lambda: page.state().options.fov == 60)
        before = page.state().cam_from_world
        visit.drag("canvas[data-engine]", 80, 30)
        until(lambda: abs(page.state().cam_from_world - before).max() > 1e-3)
        visit.page.screenshot(path=tmp_path / "page.png")
        assert (tmp_path / "page.png").stat().st_size > 10_000
        assert [text for text in visit.complaints if "THREE.Clock" not in text and "WebSocket" not in text] == []


def test_missing_viser_is_reported(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    result = CliRunner().invoke(app, ["view", str(run.folder)])
    assert result.exit_code == 1 and install_command("view") in result.stderr


def test_other_folders_are_refused(run, tmp_path):
    result = CliRunner().invoke(app, ["view", str(run.folder), "--beside", str(tmp_path)])
    assert result.exit_code == 1 and "has no config.yaml" in result.stderr


def test_the_crop_box_contains_most_points(run):
    points = run.scene.points
    low, high = (points.new_tensor(corner) for corner in crop_box(points))
    inside = ((points >= low) & (points <= high)).all(-1).float().mean()
    assert 0.9 < inside < 1
