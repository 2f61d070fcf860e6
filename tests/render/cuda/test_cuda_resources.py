"""The table of kernel resources, from output of cuobjdump."""

from __future__ import annotations

import pytest
from cuda_resources import Kernel, kernels, readable, table

BLEND = "_ZN5padgs40_GLOBAL__N__0604125a_8_blend_cu_ff982c7b12blend_kernelILb1EEEvNS_11BlendInputsE"
MOMENTS = (
    "_ZN5padgs14moments_kernelINS_15ProjectivePixelENS_51_GLOBAL__N__d4d52525_18_hybrid_backward_cu_1452a0a4"
    "11HybridPixelIS1_EELb0EEEvNS_19BlendGradientInputsE"
)
USAGE = f"""
arch = sm_90
code version = [1,8]
 Function {BLEND}:
  REG:48 STACK:0 SHARED:19472 LOCAL:0 CONSTANT[0]:784 TEXTURE:0 SURFACE:0 SAMPLER:0
 Function {MOMENTS}:
  REG:56 STACK:8 SHARED:25860 LOCAL:0 CONSTANT[0]:784 TEXTURE:0 SURFACE:0 SAMPLER:0

arch = sm_89
 Function {BLEND}:
  REG:40 STACK:0 SHARED:19472 LOCAL:0 CONSTANT[0]:784 TEXTURE:0 SURFACE:0 SAMPLER:0
"""
ELF = f"""
.nv.info
	Attribute:	EIATTR_REGCOUNT
.nv.info.{BLEND}
	Attribute:	EIATTR_MAX_THREADS
	Format:	EIFMT_SVAL
	Value:	0x100 0x1 0x1
.nv.info.{MOMENTS}
	Attribute:	EIATTR_CBANK_PARAM_SIZE
	Format:	EIFMT_HVAL
	Value:	0x230
	Attribute:	EIATTR_MAX_THREADS
	Format:	EIFMT_SVAL
	Value:	0x80 0x1 0x1
"""


def test_every_kernel_of_every_architecture_is_a_row():
    found = kernels(USAGE, ELF)
    assert found == [
        Kernel("blend 1", 89, 40, 0, 19472, 256),
        Kernel("blend 1", 90, 48, 0, 19472, 256),
        Kernel("moments projective hybrid 0", 90, 56, 8, 25860, 128),
    ]
    assert table(found).splitlines()[2] == "| blend 1 | 89 | 40 | 0 | 19472 | 256 | 67% |"  # 4 blocks of 256 in 1536
    assert readable(MOMENTS.replace("Projective", "Planar")) == "moments planar hybrid 0"
    assert readable("_ZN5padgs8_a_cu_b_16attributes_kernelINS_8Bfloat16EEEvNS_1XE") == "attributes bfloat16"


@pytest.mark.parametrize(
    ("kernel", "occupancy"),
    [
        (Kernel("by threads", 90, 32, 0, 0, 256), 1.0),
        (Kernel("by threads", 75, 64, 0, 0, 256), 1.0),  # of which that has half as many
        (Kernel("by registers", 90, 64, 0, 0, 256), 0.5),  # 65536 / (64 * 256) = 4 blocks
        (Kernel("in steps of 256", 90, 65, 0, 0, 256), 0.375),
        (Kernel("by shared memory", 86, 32, 0, 26 << 10, 256), 0.5),  # 3 of 100 KiB
        (Kernel("by blocks", 90, 16, 0, 0, 32), 0.5),  # 32 of a warp
        (Kernel("not at all", 90, 255, 0, 0, 512), 0.0),
    ],
    ids=lambda value: value.name if isinstance(value, Kernel) else None,
)
def test_occupancy_is_limited_by_the_scarcest_resource(kernel: Kernel, occupancy: float):
    assert kernel.occupancy == occupancy


def test_a_kernel_of_unknown_size_is_refused():
    with pytest.raises(ValueError, match="has no __launch_bounds__"):
        kernels(USAGE, ELF.replace("MAX_THREADS", "OTHER"))
