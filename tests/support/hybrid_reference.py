"""Hybrid blending of one pixel as published: fragments arrive one by one, evicted ones join the tail."""

from __future__ import annotations

import math


def one_pixel(alphas: list[float], distances: list[float], size: int) -> tuple[list[float], float]:
    """Return weights and transmittance of fragments in order of arrival for a core of `size`; alpha 0: no fragment."""
    core: list[int] = []
    tail: list[int] = []
    for i, alpha in enumerate(alphas):
        if 0 < alpha < 0.05:
            tail.append(i)
        elif alpha > 0:
            place = sum(distances[j] <= distances[i] for j in core)
            core.insert(place, i)
            tail += core[size:]
            del core[size:]
    weights, left = [0.0] * len(alphas), 1.0
    for i in core:
        weights[i] = alphas[i] * left
        left *= 1 - alphas[i]
        left = left if left >= 1e-4 else 0.0
    total, through = sum(alphas[i] for i in tail), math.prod(1 - alphas[i] for i in tail)
    for i in tail:
        weights[i] = left * (1 - through) * alphas[i] / total
    return weights, left * through
