"""OmniGS (Li et al. 2025): explicit Gaussians with spherical harmonics, rendered through the Jacobian of the panorama.

It is also the first row of the ablation (Table 3). conf/method/omnigs_release.yaml has the deviations of its released
code.
"""

from padgs.methods.splats.method import SplatMethod


class OmniGSMethod(SplatMethod):
    """See `padgs.training.method.Method`. Fast learning rates cost it quality in longer runs (docs/methods.md)."""

    RUN_RATES = "run_linear"
