"""A block of a city to be timed, and to compare stored values on."""

import statistics
import time
from dataclasses import dataclass, replace

import numpy as np

from tscorr import reference
from tscorr.bench.directions import Array
from tscorr.bench.variants import Variant
from tscorr.correction import BlockInputs, Stored
from tscorr.materials import Material, builtin_materials

ROOF = 32
"""pixels along the side of a roof: one material, one normal"""
BANDS = 4
SCALE = 1e-4
"""reflectance factor of a stored step of the integer image"""


@dataclass(frozen=True, slots=True)
class City:
    """A block full of roofs of the five materials of the paper, tilted up to 45 degrees, under a frame camera."""

    materials: list[Material]
    rows: Array
    """uint8 (rows, cols), from 1"""
    sun: Array
    view: Array
    normal: Array

    @classmethod
    def build(cls, shape: tuple[int, int], seed: int = 0) -> "City":
        """One of `shape` (rows, cols) pixels of 0.5 m, seen from 1000 m, the sun at a zenith angle of 40 degrees."""
        rng = np.random.default_rng(seed)
        materials = [m for m in builtin_materials().values() if m.has_peak]
        roofs = tuple(-(-side // ROOF) for side in shape)
        normal = _unit(rng.uniform(0, 45, roofs), rng.uniform(0, 360, roofs))
        kinds = rng.integers(1, len(materials) + 1, roofs).astype(np.uint8)
        row, col = np.mgrid[: shape[0], : shape[1]]
        to_camera = np.stack([600 - 0.5 * col, 0.5 * row - 300, np.full(shape, 1000.0)])
        return cls(
            materials=materials,
            rows=_enlarged(kinds, shape),
            sun=_unit(np.array([[40.0]]), np.array([[180.0]])),
            view=to_camera / np.sqrt((to_camera**2).sum(axis=0)),
            normal=_enlarged(normal, shape),
        )

    def block(self, stored: Stored, rng: np.random.Generator) -> BlockInputs:
        """Inputs of a correction, the image between 0.1 and 0.6 in reflectance."""
        reflectance = rng.uniform(0.1, 0.6, (len(stored.scale), *self.rows.shape))
        image = reflectance / stored.scale[0]
        image = np.round(image) if stored.dtype.kind in "iu" else image
        return BlockInputs(
            image=image.astype(stored.dtype), material=self.rows, sun=self.sun, view=self.view, normal=self.normal
        )


def nanoseconds_per_pixel(variants: tuple[Variant, ...], shape: tuple[int, int], rounds: int) -> dict[str, float]:
    """Processor time by name of variant, of an image of float32 with `BANDS` bands, in one thread; median of rounds.

    The rounds of the variants alternate, so that their ratios hold on a busy machine too. "angles" are timed
    for one lobe a pixel.
    """
    city, rng = City.build(shape), np.random.default_rng(0)
    stored = Stored(dtype=np.dtype(np.float32), scale=(1.0,) * BANDS, offset=(0.0,) * BANDS)
    block = city.block(stored, rng)
    angles = rng.uniform(0, [[70], [70], [180]], (3, city.rows.size))
    correctors = {v.name: v.corrector(city.materials, stored) for v in variants if v.precision != "angles"}
    seconds: dict[str, list[float]] = {variant.name: [] for variant in variants}
    for turn in range(rounds + 1):
        for variant in variants:
            if variant.precision == "angles":
                taken = _time_angles(variant, angles)
            else:
                copy = replace(block, image=block.image.copy())
                start = time.thread_time()
                correctors[variant.name](copy)
                taken = time.thread_time() - start
            if turn > 0:  # the first compiles
                seconds[variant.name].append(taken)
    return {name: 1e9 * statistics.median(values) / city.rows.size for name, values in seconds.items()}


def _time_angles(variant: Variant, angles: Array) -> float:
    """Seconds for the lobe of one material from angles (3, n)."""
    inputs = angles.astype(variant.real)
    w, n, k = (np.asarray(value, variant.real) for value in (0.08, 1.5, 0.25))
    start = time.thread_time()
    geometry = reference.geometry_from_angles(*inputs)
    reference.specular(geometry, w, n, k, simplified=variant.form == "simplified")
    return time.thread_time() - start


@dataclass(frozen=True, slots=True)
class StoredErrors:
    """How a corrected uint16 image differs from the one of the exact variant."""

    values: int
    most_steps: int
    differing: float
    """fraction of the values"""
    flags: float
    """fraction of the pixels whose flags differ"""


def stored_errors(variant: Variant, exact: Variant, shape: tuple[int, int], seed: int) -> StoredErrors:
    """Differences in stored steps of `SCALE`, of the block of a city."""
    city = City.build(shape, seed)
    stored = Stored(dtype=np.dtype(np.uint16), scale=(SCALE,) * BANDS, offset=(0.0,) * BANDS)
    block = city.block(stored, np.random.default_rng(seed))
    ours, theirs = (
        v.corrector(city.materials, stored)(replace(block, image=block.image.copy())) for v in (variant, exact)
    )
    steps = np.abs(ours.corrected.astype(int) - theirs.corrected)
    return StoredErrors(
        values=steps.size,
        most_steps=int(steps.max()),
        differing=float((steps > 0).mean()),
        flags=float((ours.flags != theirs.flags).mean()),
    )


def _unit(zenith_deg: Array, azimuth_deg: Array) -> Array:
    zenith, azimuth = np.deg2rad(zenith_deg), np.deg2rad(azimuth_deg)
    return np.stack([np.sin(zenith) * np.sin(azimuth), np.sin(zenith) * np.cos(azimuth), np.cos(zenith)])


def _enlarged(roofs: Array, shape: tuple[int, int]) -> Array:
    """Each roof as a square of pixels."""
    large = roofs.repeat(ROOF, axis=-2).repeat(ROOF, axis=-1)
    return np.ascontiguousarray(large[..., : shape[0], : shape[1]])
