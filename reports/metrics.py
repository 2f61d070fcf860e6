"""How metrics are called and read in tables."""

from __future__ import annotations

from reports.tables.table import Column

PAPER_METRICS = ("ssim", "psnr", "lpips")  # the order of the paper's tables
PROTOCOL_METRICS = {  # protocol -> the metric that stands for each of PAPER_METRICS
    "paper": {"ssim": "ssim", "psnr": "psnr", "lpips": "lpips_vgg_01"},
    "sphere": {"ssim": "ws_ssim", "psnr": "ws_psnr", "lpips": "ws_lpips_alex"},
}
TITLES = {"psnr": "PSNR", "ssim": "SSIM", "lpips": "LPIPS", "ws": "WS", "vgg": "VGG", "alex": "Alex", "01": "[0, 1]"}


def column(metric: str, group: str = "") -> Column:
    """The column of a metric.

    >>> column("ws_psnr_pole").heading, column("lpips_vgg_01").heading
    ('WS-PSNR pole ↑', 'LPIPS VGG [0, 1] ↓')
    """
    words = [TITLES.get(word, word) for word in metric.split("_")]
    title = " ".join(words).replace("WS ", "WS-")
    decimal = "psnr" in metric
    lower = "lpips" in metric or metric == "seam"
    return Column(title, 2 if decimal else 3, higher_is_better=not lower, group=group)
