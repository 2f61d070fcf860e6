"""The renderer on each instruction set that this machine has. The library chooses once, so each is a process."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from typing import Any

import torch

from padgs.apps.bench.ratios import render_both_ways
from padgs.apps.bench.workload import Size, build
from padgs.native import cpu

ISAS = ("baseline", "avx2", "avx512")


def by_instruction_set(size: Size, repeats: int, seed: int) -> dict[str, dict[str, Any]]:
    """Instruction set -> time of drawing and going back; those that the machine lacks are left out.

    Raises:
        RuntimeError: a process failed; the message is its last line.
    """
    found = {}
    for isa in ISAS:
        job = {"size": dataclasses.asdict(size), "repeats": repeats, "seed": seed, "threads": torch.get_num_threads()}
        command = [sys.executable, "-m", "padgs.apps.bench.isas", json.dumps(job)]
        environment = {"OMP_WAIT_POLICY": "PASSIVE", **os.environ, "PADGS_ISA": isa}
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"timing instruction set {isa} failed: {done.stderr.strip().splitlines()[-1]}")
        answer = json.loads(done.stdout)
        found[answer.pop("isa")] = answer
    return found


if __name__ == "__main__":
    job = json.loads(sys.argv[1])
    torch.set_num_threads(job["threads"])
    timing = render_both_ways(build(Size(**job["size"]), job["seed"]), job["repeats"])
    print(json.dumps({"isa": cpu.library().padgs_isa().decode(), **timing}))
