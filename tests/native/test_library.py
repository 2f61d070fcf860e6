"""Selection, loading and absence of the native library."""

import ctypes
import os
import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from support.render_cases import gaussians_of, identity_pose, needs_native

from padgs import render as package
from padgs.gaussians import Gaussians
from padgs.native import cpu, loading
from padgs.native.abi import NativeCamera
from padgs.render import render
from padgs.scene import View

ROOT = Path(__file__).resolve().parents[2]
VIEW = View("v", identity_pose(), 72, 36)


def in_a_new_process(code: str, *arguments: str, **environment: str) -> str:
    search_path = os.pathsep.join(filter(None, (str(ROOT), str(Path(__file__).parent), os.environ.get("PYTHONPATH"))))
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        env={**os.environ, "PYTHONPATH": search_path, **environment},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow  # a process
@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="needs /proc to see what is loaded")
def test_importing_loads_no_library():
    code = """
import padgs.render
print("padgs_cpu" in open("/proc/self/maps").read())
"""
    assert in_a_new_process(code).split() == ["False"]


@pytest.fixture
def missing_library(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """A machine without compiled libraries."""
    caches = (cpu.library, cpu.available, package._warn_missing_library)
    monkeypatch.setenv("PADGS_LIBRARY_DIR", str(tmp_path))
    monkeypatch.setattr(loading, "_package_folders", lambda: [str(tmp_path / "padgs" / "render")])
    for cached in caches:
        cached.cache_clear()
    yield
    for cached in caches:
        cached.cache_clear()


@pytest.fixture
def gaussians(generator: torch.Generator) -> Gaussians:
    return gaussians_of("ordinary", 5, generator).to(torch.float32)


def test_missing_library_warns_once_and_uses_torch(missing_library: None, gaussians: Gaussians):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        images = [render(gaussians, VIEW).image for _ in range(3)]
    assert len(caught) == 1
    message = str(caught[0].message)
    assert "backend torch" in message and "C++ compiler" in message and "padgs_cpu" in message
    assert caught[0].filename == __file__  # the warning points at who called render
    assert torch.equal(images[0], render(gaussians, VIEW, backend="torch").image)


def test_missing_library_warns_only_if_it_would_be_used(missing_library: None, gaussians: Gaussians):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        render(gaussians.to(torch.float64), VIEW)
        render(gaussians, VIEW, backend="torch")


def test_missing_library_error(missing_library: None, gaussians: Gaussians, tmp_path: Path):
    with pytest.raises(OSError, match="padgs_cpu.* not found in .*C\\+\\+ compiler.* or use backend=torch") as error:
        render(gaussians, VIEW, backend="cpu")
    assert str(tmp_path) in str(error.value)


@needs_native
def test_auto_is_cpu_for_float32_and_torch_for_float64(gaussians: Gaussians):
    assert package.resolve_backend("auto", gaussians.means) == "cpu"
    assert package.resolve_backend("auto", gaussians.means.double()) == "torch"
    assert package.resolve_backend("auto", gaussians.means.to("meta")) == "torch"
    assert package.resolve_backend("torch", gaussians.means) == "torch"


@needs_native
def test_a_library_of_another_version_is_refused(monkeypatch):
    class Grown(ctypes.Structure):
        _fields_ = [*NativeCamera._fields_, ("more", ctypes.c_int32)]

    monkeypatch.setattr(cpu, "STRUCTURES", (Grown, *cpu.STRUCTURES[1:]))
    with pytest.raises(OSError, match="libpadgs_cpu.* is of another version, with another Grown; build it again"):
        cpu.library.__wrapped__()
