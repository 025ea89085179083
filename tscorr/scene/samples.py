"""Samples of each material from the images of scenes, for `tscorr.fit.scenes` to fit.

A lobe is narrow, and most pixels see none of it. So samples are drawn evenly over facet tilt: from each scene,
for each material and each degree of tilt, the same number of pixels at most. A hash of their place decides which,
so that blocks and threads do not matter; the strata bound the memory.
"""

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from tempfile import gettempdir
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tscorr.angles import facet_angles
from tscorr.correction import BlockInputs, class_rows
from tscorr.errors import InputError
from tscorr.fit.images import ImageSamples, merged
from tscorr.fit.library import check_replaceable, save_converged
from tscorr.fit.scene_result import SceneFit
from tscorr.fit.scenes import MIN_SAMPLES, SceneFitSettings, fit_samples
from tscorr.grid import Block
from tscorr.scene.cutting import units_of, workers_of
from tscorr.scene.plan import Scene
from tscorr.scene.run import Pipeline, Progress, run_all, silent

Array = NDArray[Any]

TILT_STRATA = 90
"""one a degree"""
PER_STRATUM = 100
MAX_ZENITH_DEG = 80.0
"""of incidence and exitance: beyond it a degree of slope changes the light by a tenth and more"""
OF_PLACE = 6
"""numbers of a sample before its bands: incidence, exitance, relative azimuth, plane factor c, sky view, roof"""
ROOF_PX = 40
"""samples in one square of so many pixels count as one roof, whose errors are common"""


class FittedScenes(NamedTuple):
    """Results by material name, and the same as text."""

    results: dict[str, SceneFit]
    text: str
    unfinished: tuple[str, ...]
    """materials whose fits did not converge, which are not written"""


def fit_scenes(
    scenes: Sequence[Scene],
    output: str | Path | None = None,
    settings: SceneFitSettings | None = None,
    progress: Callable[[Scene], Callable[[int], None]] | None = None,
) -> FittedScenes:
    """Fit every material with a peak to what the scenes show of it.

    scenes   : of one city, seen in different directions, with the same bands; made by `plan_scene`.
    output   : material file to write.
    settings : of the fit.
    progress : given a scene that starts, a function that is told of pixels done.
    Materials that the libraries know without a peak, or that are not enabled, are left alone; so are those with
    fewer than 100 samples, which the text says. Those whose fits do not converge are not written. Raises InputError
    where the scenes differ in their bands, or where no material can be fitted; then nothing is written.
    """
    settings = settings or SceneFitSettings()
    check_replaceable(output, {surface.name for scene in scenes for surface, _, _ in scene.materials})
    gathered = gather(scenes, seed=settings.seed, progress=progress)
    results = {
        name: fit_samples(samples, settings) for name, samples in gathered.items() if len(samples) >= MIN_SAMPLES
    }
    left_out = [f"{name}: left out, {len(found)} samples" for name, found in gathered.items() if name not in results]
    if not results:
        raise InputError(
            "no material can be fitted: " + ("; ".join(left_out) or "no material of [materials.classes] has a peak")
        )
    unfinished = save_converged(results, output)
    text = "\n\n".join([*(result.summary() for result in results.values()), *left_out])
    return FittedScenes(results, text, unfinished)


def gather(
    scenes: Sequence[Scene],
    *,
    seed: int = 0,
    per_stratum: int = PER_STRATUM,
    progress: Callable[[Scene], Callable[[int], None]] | None = None,
) -> dict[str, ImageSamples]:
    """Samples of the materials with a peak, by name, from all scenes together.

    Lit, seen and unsaturated pixels with a normal to be trusted, amid others of their class, with incidence and
    exitance up to 80 degrees. Raises InputError where the scenes differ in their bands.
    """
    _check_bands(scenes)
    found: dict[str, list[ImageSamples]] = {}
    for number, scene in enumerate(scenes):
        key = (seed << 16) + number
        for samples in _of_scene(scene, key, per_stratum, progress(scene) if progress else silent):
            found.setdefault(samples.name, []).append(samples)
    return {name: merged(parts) for name, parts in sorted(found.items())}


def _check_bands(scenes: Sequence[Scene]) -> None:
    first = scenes[0]
    for scene in scenes:
        if scene.wavelengths_um is None and scene.image.bands > 1:
            raise InputError(
                f"the wavelengths of the bands of {scene.image.path} are not known: give wavelength_um = [...]"
            )
        if scene.wavelengths_um != first.wavelengths_um:
            raise InputError(
                f"scenes '{first.name}' and '{scene.name}' have bands at {first.wavelengths_um} and "
                f"{scene.wavelengths_um} um; materials are fitted to scenes with the same bands"
            )


def _of_scene(scene: Scene, key: int, per_stratum: int, progress: Progress) -> list[ImageSamples]:
    """Samples of the materials of one scene."""
    with ExitStack() as files:
        gatherer = _Gatherer(scene, key, per_stratum, files)
        run_all(gatherer.block, units_of(scene), workers_of(scene), progress)
        return list(gatherer.samples())


class _Gatherer:
    """The pixels of one scene, block by block, into a reservoir for each material."""

    def __init__(self, scene: Scene, key: int, per_stratum: int, files: ExitStack) -> None:
        self._scene = scene
        self._key = key
        self._pipeline = Pipeline(scene, Path(gettempdir()))  # its readers and directions; it writes no result
        self._pipeline.open(files)
        self._pipeline.ground.prepare()
        self._reservoirs = {
            row: Reservoir(per_stratum, OF_PLACE + scene.image.bands)
            for row, (material, _, rules) in enumerate(scene.materials, start=1)
            if material.has_peak and rules.enabled
        }

    def block(self, block: Block) -> int:
        """Add the samples of one block; the number of its pixels."""
        around = class_rows(self._pipeline.classes.read(block.padded(1), 1), self._scene.rows)
        rows = around[1:-1, 1:-1]
        usable = np.isin(rows, list(self._reservoirs)) & _amid_its_own(around)
        if usable.any():
            image = self._pipeline.image.read(block)
            self._pipeline.bad_bands.set_aside(image)
            usable &= self._valid(image)
            inputs, _ = self._pipeline.inputs(block, image, np.ascontiguousarray(rows), usable)
            for mask in (inputs.shadowed, inputs.hidden, inputs.unreliable, inputs.low_confidence):
                if mask is not None:
                    usable &= ~mask
            if (shadow := self._pipeline.ground.shadowed(block)) is not None:
                usable &= ~shadow[1]  # the rim, which the library's t0 has decided: it may be wrong
            self._add(block, inputs, usable)
        return rows.size

    def _add(self, block: Block, inputs: BlockInputs, usable: Array) -> None:
        """Add the usable pixels of a block."""
        sun, view, normal = (
            np.broadcast_to(vectors, (3, *block.shape))[:, usable].astype(np.float64)
            for vectors in (inputs.sun, inputs.view, inputs.normal)
        )
        angles = facet_angles(sun, view, normal)
        row, col = np.nonzero(usable)
        row, col = row + block.row, col + block.col
        stored = self._scene.stored
        values = np.stack(
            [
                angles["incidence"],
                angles["exitance"],
                angles["relative_azimuth"],
                np.cos(np.deg2rad(angles["incidence"])) / sun[2],
                (1 + normal[2]) / 2,
                self._roof(row, col),
                *(inputs.image[:, usable] * _column(stored.scale) + _column(stored.offset)),
            ]
        )
        keys = _hashed(row * self._scene.grid.shape[1] + col, self._key)
        strata = angles["facet_tilt"].astype(np.int64)
        allowed = np.maximum(angles["incidence"], angles["exitance"]) <= MAX_ZENITH_DEG
        for place, reservoir in self._reservoirs.items():
            mine = allowed & (inputs.material[usable] == place)
            reservoir.add(strata[mine], keys[mine], values[:, mine])

    def _valid(self, image: Array) -> Array:
        """Where every band holds a value below saturation."""
        stored = self._scene.stored
        valid = np.isfinite(image)
        if stored.nodata is not None:
            valid &= image != stored.nodata
        if stored.saturation is not None:
            valid &= image < _column(stored.saturation)[..., None]
        return np.logical_and.reduce(valid)

    def _roof(self, row: Array, col: Array) -> Array:
        """A number for the square of the map that a pixel lies in, the same in all scenes."""
        x, y = self._scene.grid.xy(row, col)
        width, height = (ROOF_PX * size for size in self._scene.grid.cell_size)
        return np.floor(x / width) * 2.0**24 + np.floor(y / height)

    def samples(self) -> Iterator[ImageSamples]:
        """What was gathered, material by material."""
        for place, reservoir in self._reservoirs.items():
            material, _, rules = self._scene.materials[place - 1]
            incidence, exitance, phi, plane, sky_view, roof = reservoir.values[:OF_PLACE]
            if rules.irradiance_plane == "facet":
                plane = sky_view = np.ones_like(plane)
            good = self._scene.good_bands
            beta = _column(np.broadcast_to(rules.direct_fraction, self._scene.image.bands)[good].tolist())
            wavelengths = self._scene.wavelengths_um
            yield ImageSamples(
                name=material.name,
                incidence_deg=incidence,
                exitance_deg=exitance,
                relative_azimuth_deg=phi,
                reflectance_factor=reservoir.values[OF_PLACE:][good],
                direct=beta * plane,
                diffuse=beta * plane + (1 - beta) * sky_view,
                roof=roof,
                wavelength_um=() if wavelengths is None else tuple(wavelengths[band] for band in good),
                source=self._scene.name,
            )


def _column(values: Sequence[float]) -> Array:
    """One value a band, against samples."""
    return np.asarray(values, dtype=float)[:, None]


def _amid_its_own(rows: Array) -> Array:
    """Pixels whose 3 x 3 neighbours are of the same class: rows (rows + 2, cols + 2) -> bool (rows, cols)."""
    height, width = rows.shape[0] - 2, rows.shape[1] - 2
    middle = rows[1:-1, 1:-1]
    same = np.ones(middle.shape, np.bool_)
    for row in range(3):
        for col in range(3):
            same &= rows[row : row + height, col : col + width] == middle
    return same


def _hashed(place: Array, key: int) -> Array:
    """Well-mixed uint64 of whole numbers: the finaliser of splitmix64 (Steele, Lea, Flood 2014)."""
    z = place.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(key)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


class Reservoir:
    """Samples of one material, at most `capacity` of each stratum: those of the smallest keys."""

    def __init__(self, capacity: int, columns: int) -> None:
        self._capacity = capacity
        self._strata = np.empty(0, np.int64)
        self._keys = np.empty(0, np.uint64)
        self.values: Array = np.empty((columns, 0))
        """(columns, n), ordered by stratum and key"""
        self._lock = threading.Lock()

    def add(self, strata: Array, keys: Array, values: Array) -> None:
        """Add samples: strata and keys (n,), values (columns, n)."""
        few = _smallest(strata, keys, self._capacity)
        with self._lock:
            strata, keys = np.append(self._strata, strata[few]), np.append(self._keys, keys[few])
            values = np.concatenate([self.values, values[:, few]], axis=1)
            kept = _smallest(strata, keys, self._capacity)
            self._strata, self._keys, self.values = strata[kept], keys[kept], values[:, kept]


def _smallest(strata: Array, keys: Array, capacity: int) -> Array:
    """Places of the `capacity` smallest keys of each stratum, ordered by stratum and key."""
    order = np.lexsort((keys, strata))
    ordered = strata[order]
    rank = np.arange(len(order)) - np.searchsorted(ordered, ordered, side="left")
    return order[rank < capacity]
