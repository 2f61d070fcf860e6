"""`padgs-run` as a process."""

import subprocess

SMALLEST = [  # half a minute's worth of nothing: what is tested is the machinery around it
    "protocol=paper",
    "protocol.paper.lpips=none",
    "data.generator.width=64",
    "data.generator.train_views=4",
    "data.generator.test_views=1",
    "data.generator.samples=1",
    "data.generator.points=400",
    "run.threads=1",
]


def finish(process: subprocess.Popen) -> tuple[int, str, str]:
    """Exit code and what was said, once it has ended."""
    out, error = process.communicate(timeout=400)
    return process.returncode, out, error
