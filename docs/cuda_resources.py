"""Print registers, stack, shared memory and occupancy of every padgs kernel in compiled CUDA code, as Markdown.

    python docs/cuda_resources.py build/libpadgs_cuda.so [--cuobjdump PROGRAM]

Reads the code with cuobjdump of the CUDA toolkit (or `pip install nvidia-cuda-cuobjdump`); no GPU is needed. Occupancy
is the share of the threads of an SM that can be resident. A stack is an array of the source or spilled registers.
"""

from __future__ import annotations

import argparse
import re
import subprocess
from dataclasses import dataclass
from pathlib import Path

RESERVED = 1 << 10  # bytes of shared memory per block for the system; from 9.0 on cuobjdump includes them
REGISTERS = 65536  # of an SM; a warp takes them in units of 256
# Threads, blocks and bytes of shared memory of an SM, by compute capability: CUDA C++ Programming Guide, "Compute
# Capabilities".
SMS = {
    75: (1024, 16, 64 << 10),
    80: (2048, 32, 164 << 10),
    86: (1536, 16, 100 << 10),
    89: (1536, 24, 100 << 10),
    90: (2048, 32, 228 << 10),
    100: (2048, 32, 228 << 10),
    120: (1536, 24, 100 << 10),
}


@dataclass(frozen=True)
class Kernel:
    """Resources of one kernel on one architecture: bytes of stack per thread, and of shared memory per block."""

    name: str
    architecture: int
    registers: int
    stack: int
    shared: int
    threads: int  # of a block

    @property
    def occupancy(self) -> float:
        """Return the share of the threads of an SM; 0 if no block fits."""
        threads, blocks, shared = SMS[self.architecture]
        warps = -(-self.threads // 32)
        by_registers = REGISTERS // (warps * -(-self.registers * 32 // 256) * 256)
        by_shared = shared // (self.shared + (RESERVED if self.architecture < 90 else 0) or 1)
        return min(blocks, by_registers, by_shared, threads // (32 * warps)) * self.threads / threads


def kernels(usage: str, elf: str) -> list[Kernel]:
    """Parse the output of `cuobjdump --dump-resource-usage` and `--dump-elf`.

    Raises:
        ValueError: a kernel has no `__launch_bounds__`.
    """
    in_its_section = r"\.nv\.info\.(\w+)\n(?:(?!\.nv\.info).)*?"
    threads = dict(re.findall(in_its_section + r"EIATTR_MAX_THREADS.*?Value:\s*0x(\w+)", elf, re.S))
    of_kernel = r"Function (_ZN5padgs\w+):\s*REG:(\d+) STACK:(\d+) SHARED:(\d+)"
    found = []
    for architecture, part in re.findall(r"arch = sm_(\d+)(.*?)(?=arch = |\Z)", usage, re.S):
        for name, registers, stack, shared in re.findall(of_kernel, part):
            if name not in threads:
                raise ValueError(f"{name} has no __launch_bounds__, so the size of its blocks is unknown; add them")
            numbers = map(int, (architecture, registers, stack, shared))
            found.append(Kernel(readable(name), *numbers, threads=int(threads[name], 16)))
    return sorted(found, key=lambda kernel: (kernel.name, kernel.architecture))


def readable(mangled: str) -> str:
    """Return the distinctive part of the mangled name of a kernel."""
    (own,) = re.findall(r"\d([a-z_]+_kernel)", mangled)
    arguments = mangled.split(own)[1].split("EEv")[0]
    told = re.findall(r"(Planar|Projective)Pixel|(Sorted|Hybrid)Pixel|Lb([01])|Li(\d+)|(B?[Ff]loat16)", arguments)
    words = [next(filter(None, groups)).lower() for groups in told]
    return f"{own.removesuffix('_kernel')} {' '.join(dict.fromkeys(words))}".strip()


def table(found: list[Kernel]) -> str:
    """Return a Markdown table with a row for each kernel and architecture."""
    rows = ["| kernel | sm | registers | stack, B | shared, B | threads | occupancy |", "| --- |" + " ---: |" * 6]
    for k in found:
        numbers = (k.architecture, k.registers, k.stack, k.shared, k.threads, f"{k.occupancy:.0%}")
        rows.append(f"| {k.name} | {' | '.join(map(str, numbers))} |")
    return "\n".join(rows)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("code", type=Path, help="a library or a cubin")
    parser.add_argument("--cuobjdump", default="cuobjdump", help="the program")
    chosen = parser.parse_args()
    printed = [
        subprocess.run([chosen.cuobjdump, how, chosen.code], check=True, capture_output=True, text=True).stdout
        for how in ("--dump-resource-usage", "--dump-elf")
    ]
    print(table(kernels(*printed)))


if __name__ == "__main__":
    main()
