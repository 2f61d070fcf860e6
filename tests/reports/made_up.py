"""Results that nobody measured, for tests of tables."""

from dataclasses import replace

from padgs.results import Result, Scores

RULES = {"name": "paper", "lpips": "vgg", "lpips_inputs": "01", "bottom_crop": 0.0}


def result(
    variant: str = "full", *, psnr: float = 23.5, ssim: float = 0.81, lpips: float | None = 0.229, **others
) -> Result:
    marks = {"psnr": psnr, "ssim": ssim, "lpips_vgg_01": lpips}
    made = Result(
        run=f"bar_padgs_{variant}_{others.get('seed', 0)}",
        status="ok",
        method="padgs",
        preset="padgs",
        variant=variant,
        dataset="roam360",
        scene="bar",
        width=2048,
        height=1024,
        iterations=30_000,
        iterations_done=30_000,
        seed=0,
        code_version="0.1.0 abc",
        machine={"cores": 2, "cpu": "A & B_1", "torch": "2.13.0"},
        config_hash="c",
        fingerprint="f",
        finished="2026-11-21T00:00:00+00:00",
        scores={"paper": Scores(RULES, marks, {"a": marks})},
        config={"train": {"iterations": 30_000}, "method": {"tau": 0.9}, "seed": 0},
    )
    return replace(made, **others)


def failed(variant: str, status: str, **others) -> Result:
    return replace(result(variant, **others), status=status, scores={}, reason="no more")
