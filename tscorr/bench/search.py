"""The worst input of a function, by search: from the worst of many starting points, ever smaller steps."""

from collections.abc import Callable

import numpy as np

from tscorr.bench.directions import Array, Directions, clipped

LINEAGES, CHILDREN = 24, 48


def climb(
    excess: Callable[[Directions], Array],
    start: Directions,
    values: Array,
    rng: np.random.Generator,
    *,
    max_zenith_deg: float,
    rounds: int,
) -> tuple[Directions, Array]:
    """Directions, and their values, at which `excess` is larger than at any of `start`, where it has `values`.

    The worst `LINEAGES` points of the start each have `CHILDREN` neighbours a round, at distances spread over
    powers of ten, and the best of the family goes on. nan counts as nothing.
    """
    best = np.argsort(np.nan_to_num(values, nan=-np.inf))[-LINEAGES:]
    parents, heights = start.take(best), values[best]
    families = len(best)
    for _ in range(rounds):
        scale = 10 ** rng.uniform(-6, 1, (families, CHILDREN, len(parents)))
        moved = rng.random(scale.shape) < 0.5  # not every angle at once
        steps = rng.normal(size=scale.shape) * scale * moved
        children = clipped(
            Directions(
                *((angle[:, None] + steps[..., number]).ravel() for number, angle in enumerate(parents)),
            ),
            max_zenith_deg,
        )
        found = np.nan_to_num(excess(children), nan=-np.inf).reshape(families, CHILDREN)
        first = found.argmax(axis=1)
        family = np.arange(families)
        chosen = children.take(family * CHILDREN + first)
        better = found[family, first] > heights
        parents = Directions(*(np.where(better, new, old) for new, old in zip(chosen, parents, strict=True)))
        heights = np.where(better, found[family, first], heights)
    return parents, heights
