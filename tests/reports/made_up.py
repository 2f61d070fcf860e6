"""Results that nobody measured, for tests of tables."""

from dataclasses import replace

from padgs.results import Result, Scores
from reports import published

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
    if "method" in others:
        others.setdefault("preset", others["method"])
    return replace(made, **others)


def failed(variant: str, status: str, **others) -> Result:
    return replace(result(variant, **others), status=status, scores={}, reason="no more")


def data_set(dataset: str, methods: tuple[str, ...] = ("omnigs", "padgs"), seeds: int = 1) -> list[Result]:
    """A result for each scene, method and seed of a data set; PSNR is 20 dB + a bit per scene, method and seed."""
    scenes = published.scenes(published.load(), published.DATASETS[dataset])
    return [
        result(
            "",
            method=method,
            dataset=dataset,
            scene=scene,
            seed=seed,
            run=f"{scene}_{method}_{seed}",
            fingerprint=scene,
            psnr=20 + place + 0.5 * methods.index(method) + 0.1 * seed,
            ssim=0.7 + 0.01 * place + 0.005 * methods.index(method),
            lpips=0.4 - 0.01 * place,
            timing={"train_seconds": 3600.0, "render_ms_median": 40.0},
            counts={"gaussians": 100_000},
            model_bytes=24_000_000,
            peak_memory_bytes=2_500_000_000,
        )
        for place, scene in enumerate(scenes)
        for method in methods
        for seed in range(seeds)
    ]
