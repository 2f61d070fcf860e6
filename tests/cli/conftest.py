import os
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.fixture(scope="module")
def cache(tmp_path_factory) -> Path:
    """One folder of generated scenes for all processes."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def start(tmp_path, cache, root):
    """Start `padgs-run` in an empty folder, in a process group of its own."""

    def started(*arguments: str) -> subprocess.Popen:
        environment = os.environ | {"PYTHONPATH": str(root), "PADGS_CACHE": str(cache), "COLUMNS": "200"}
        environment.pop("PADGS_ROOT", None)
        command = [sys.executable, "-W", "ignore", "-m", "padgs.cli.run", *arguments]
        pipe = subprocess.PIPE
        return subprocess.Popen(
            command, cwd=tmp_path, env=environment, stdout=pipe, stderr=pipe, text=True, start_new_session=True
        )

    return started
