"""What each threshold of `negligible_reflectance` would leave undone, estimated from a sample of a scene.

The sample is of windows spread over the scene. Slopes are those of the surface model smoothed over a few pixels, which
is rougher than what a run computes; shadows, nodata and the errors of normals are left out.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tscorr import config, rasters, reference
from tscorr.correction import class_rows
from tscorr.grid import Block, blocks
from tscorr.scene.plan import Scene
from tscorr.scene.reach import Reach

Array = NDArray[Any]

THRESHOLDS = 1e-4, 5e-4, 1e-3, 5e-3
"""beside the one that is set"""
WINDOWS, WINDOW_PX = 5, 48
"""the sample is of WINDOWS x WINDOWS windows of WINDOW_PX"""
SMOOTH_PX = 5
MOST_BLOCKS = 100


def by_threshold(scene: Scene, present: Mapping[Block, Sequence[int]]) -> list[dict[str, Any]]:
    """For each threshold the shares of the pixels and of the blocks in which nothing would be removed.

    present : rows of the corrector with a lobe in each block.
    The first is what the scene is set to: half a stored step, unless it says otherwise.
    """
    largest = np.concatenate([_largest(scene, window) for window in _windows(scene)])
    own = [rules.negligible_reflectance for *_, rules in scene.materials if rules.enabled]
    values = sorted({*own, *THRESHOLDS})
    return [
        {
            "negligible_reflectance": float(value),
            "set": value in own,
            "pixels": float(np.mean(largest < value)),
            "blocks": _idle_share(scene, present, value),
        }
        for value in values
    ]


def _windows(scene: Scene) -> Iterator[Block]:
    """Windows spread over a scene; all of it where it is small."""
    rows, cols = scene.image.shape
    cut = list(blocks((rows, cols), (WINDOW_PX, WINDOW_PX)))
    across = -(-cols // WINDOW_PX)
    down, right = (np.unique(np.linspace(0, n - 1, WINDOWS).astype(int)) for n in (len(cut) // across, across))
    for i in down:
        for j in right:
            yield cut[int(i) * across + int(j)]


def _largest(scene: Scene, window: Block) -> Array:
    """The largest specular reflectance over the bands of the pixels of a window: (pixels,); 0 without a lobe."""
    with ExitStack() as files:
        classes = class_rows(files.enter_context(scene.classes()).read(window, 1), scene.rows)
        heights, normal = _surface(scene, window, files)
    look = scene.view.look(scene.grid, window, heights)
    sun = scene.sun.vectors(window, look.seconds)
    sun, view, normal = (np.broadcast_to(vectors, (3, *window.shape)) for vectors in (sun, look.vectors, normal))
    result = np.zeros(window.shape)
    for row, (_, parameters, rules) in enumerate(scene.materials, start=1):
        mine = classes == row
        if rules.enabled and mine.any():
            angles = reference.geometry(sun[:, mine], view[:, mine], normal[:, mine])
            w, n, k = (values[:, None] for values in (parameters.w, parameters.n, parameters.k))
            lobe = reference.specular(angles, w, n, k, simplified=rules.form == "simplified")
            plane = angles.cos_i / sun[2][mine] if rules.irradiance_plane == "horizontal" else 1.0
            gain = np.pi * np.asarray(rules.direct_fraction)[:, None] * parameters.t1[:, None]
            result[mine] = np.nan_to_num(gain * lobe * plane).max(axis=0)
    return result.ravel()


def _surface(scene: Scene, window: Block, files: ExitStack) -> tuple[Array, Array]:
    """Heights (rows, cols) or (1, 1), and normals (3, rows, cols) or (3, 1, 1), of a window."""
    up = np.array([0.0, 0.0, 1.0]).reshape(3, 1, 1)
    settings, margin = scene.settings.surface, SMOOTH_PX // 2 + 1
    heights = np.full((1, 1), scene.ground_level_m)
    if isinstance(settings, config.NormalsSettings):
        reader = rasters.Reader(scene.surface_files[-1], scene.grid, fill=float("nan"))
        normal = files.enter_context(reader).read(window).astype(float)
        return heights, np.where(np.isfinite(normal).all(axis=0), normal, up)
    if (surface := scene.heights(margin)) is None:
        return heights, up
    around = files.enter_context(surface).read(window.padded(margin), 1).astype(float)
    around = np.where(np.isnan(around), scene.ground_level_m, around)
    smooth = np.lib.stride_tricks.sliding_window_view(around, (SMOOTH_PX, SMOOTH_PX)).mean(axis=(2, 3))
    cell_x_m, cell_y_m = scene.grid.cell_size
    south, east = np.gradient(smooth, cell_y_m, cell_x_m)
    normal = np.stack([-east, south, np.ones_like(east)])[:, 1:-1, 1:-1]
    return smooth[1:-1, 1:-1], normal / np.sqrt((normal**2).sum(axis=0))


def _idle_share(scene: Scene, present: Mapping[Block, Sequence[int]], value: float) -> float:
    """Share of the blocks in which no material with a lobe is, or none that it can reach for certain."""
    materials = tuple(
        (surface, parameters, replace(rules, negligible_reflectance=value))
        for surface, parameters, rules in scene.materials
    )
    reach = Reach.of(replace(scene, materials=materials))
    chosen = list(present)[:: -(-len(present) // MOST_BLOCKS)]
    idle = [
        not present[block] or (reach is not None and reach.attenuated(block, list(present[block])) is not None)
        for block in chosen
    ]
    return float(np.mean(idle))
