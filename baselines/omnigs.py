"""OmniGS: explicit 3D Gaussians with spherical harmonics, drawn through the Jacobian of the panorama.

Also the first row of the ablation (Table 3). The defaults of all explicit Gaussians are the method as described;
conf/method/omnigs_release.yaml switches on what its released code does otherwise.
"""

from __future__ import annotations

from padgs.methods.splats.method import SplatMethod


class OmniGSMethod(SplatMethod):
    """See `padgs.training.method.Method`."""
