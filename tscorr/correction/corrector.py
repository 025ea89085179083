"""A block in, a block without its specular part out."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tscorr import kernels
from tscorr.correction import oracle
from tscorr.correction.ahead import compiling
from tscorr.correction.extras import extras_table, is_extra, signed
from tscorr.correction.flags import SPECULAR_STATE_SHIFT, PixelFlag, SpecularState
from tscorr.correction.rules import Stored
from tscorr.correction.tables import (
    Entry,
    computed_precision,
    material_table,
    new_tally,
    pixel_rules,
)
from tscorr.errors import InputError

Array = NDArray[Any]


UNKNOWN_MATERIAL = PixelFlag.NO_MATERIAL | SpecularState.NOT_ASSESSED << SPECULAR_STATE_SHIFT


@dataclass(frozen=True, slots=True, kw_only=True)
class BlockInputs:
    """One block of a scene.

    image    : (bands, rows, cols), stored values; corrected in place. Of no bands where no value of it matters.
    material : uint8 (rows, cols), the material's place in the `Corrector`, from 1; 0 is none.
    sun, view, normal : unit vectors (3, rows, cols), or (3, 1, 1) where constant; east, north, up.
    shadowed, hidden, unreliable, low_confidence : bool (rows, cols), or None where nowhere true.
    weight : the part of each pixel that is its material, float32 (rows, cols), or None for all of it.
    normal_sigma_deg : 1 sigma of the normals along each of two axes, float32 (rows, cols), or (1, 1) where constant;
             or None for no error.
    """

    image: Array
    material: Array
    sun: Array
    view: Array
    normal: Array
    shadowed: Array | None = None
    hidden: Array | None = None
    unreliable: Array | None = None
    low_confidence: Array | None = None
    weight: Array | None = None
    normal_sigma_deg: Array | None = None

    def flags(self) -> Array:
        """The bits that are known before the correction: uint16 (rows, cols)."""
        flags = None
        for mask, flag in (
            (self.shadowed, PixelFlag.CAST_SHADOW),
            (self.hidden, PixelFlag.NOT_VIEWED),
            (self.unreliable, PixelFlag.NORMAL_UNRELIABLE),
            (self.low_confidence, PixelFlag.LOW_CONFIDENCE),
        ):
            if mask is not None:
                bits = mask.astype(np.uint16)
                bits *= np.uint16(flag)
                flags = bits if flags is None else np.bitwise_or(flags, bits, out=flags)
        return np.zeros(self.material.shape, np.uint16) if flags is None else flags


@dataclass(frozen=True, slots=True)
class BlockResult:
    """A corrected block: the image that came in, what was removed (or None), flags and sums for the report.

    sigma : float32 (bands, rows, cols), 1 sigma of the corrected reflectance factor; None where not asked for.
    """

    corrected: Array
    removed: Array | None
    flags: Array
    tally: kernels.Tally
    sigma: Array | None = None


@dataclass(frozen=True, slots=True)
class _Engine:
    """The materials of one precision."""

    precision: str
    table: kernels.MaterialTable
    mine: Array
    """bool (materials,): which rows of the table are its own"""
    extras: kernels.Extras | None
    """None: plain subtraction, and nothing of the uncertainty"""


class Corrector:
    """Corrects the blocks of one scene: materials in order, their rules, and the meaning of stored values.

    materials   : each with its parameters for the bands and its rules; row i + 1 of the tables.
    uncertainty : say how sure the results are. What is not asked for is neither computed nor compiled.
    weighted    : the blocks come with weights.
    """

    def __init__(
        self,
        materials: Sequence[Entry],
        stored: Stored,
        *,
        skip: bool = True,
        tally_stride: int = 1,
        uncertainty: bool = False,
        weighted: bool = False,
    ) -> None:
        if len(materials) > 254:
            raise InputError(f"a scene has {len(materials)} materials; allowed are 254")
        if not stored.has_nodata and any(rules.uncorrectable == "nodata" for *_, rules in materials):
            raise InputError(f"uncorrectable = 'nodata', but the image of {stored.dtype} has no nodata value")
        self.names = tuple(entry[0].name for entry in materials)
        self.stored = stored
        self.skip = skip
        self.tally_stride = tally_stride
        self.uncertainty = uncertainty
        self.removed_type = signed(stored.dtype, materials)
        self._asked = uncertainty or weighted or any(is_extra(rules) for *_, rules in materials)
        self._pixels = pixel_rules(stored)
        self._until_compiled: Callable[[], None] = lambda: None
        precisions = [computed_precision(parameters, rules) for _, parameters, rules in materials]
        self._engines = [
            self._engine(precision, np.array([False, *(own == precision for own in precisions)]), materials, stored)
            for precision in sorted(set(precisions)) or ["fast"]
        ]

    def _engine(self, precision: str, mine: Array, materials: Sequence[Entry], stored: Stored) -> _Engine:
        real = np.float32 if precision == "fast" else np.float64
        table = material_table(materials, len(stored.scale), real)
        extras = extras_table(materials, stored, real) if self._asked else None
        peak = table.peak if extras is None else table.peak | extras.has_sky
        return _Engine(precision, table._replace(peak=peak & mine), mine, extras)

    def have_peaks(self, rows: Array) -> Array:
        """Which pixels have a lobe: bool, of the corrector's row of each, uint8 (rows, cols)."""
        peaks = self.peaks
        if peaks[1:].all():
            return rows != 0  # in a tenth of the time
        return looked_up(rows, peaks.tobytes().ljust(256, b"\0")).view(np.bool_)

    @property
    def is_compiled(self) -> bool:
        """Whether only compiled code looks at directions, which it does only where a pixel has a lobe."""
        return all(engine.precision != "reference" for engine in self._engines)

    @property
    def peaks(self) -> Array:
        """Which rows have a lobe to remove: bool (materials + 1,); row 0, no material, has none."""
        return np.logical_or.reduce([engine.table.peak for engine in self._engines])

    @contextmanager
    def compiled_ahead(self, sample: Callable[[], BlockInputs]) -> Iterator[None]:
        """Within this context another process compiles, if need be, what blocks like the sample need."""

        def calls() -> list[tuple[Any, ...]]:
            inputs = sample()
            results = self._results(inputs, everywhere=inputs.image.shape, want_removed=False)
            compiled = (engine for engine in self._engines if engine.precision != "reference")
            return [self._arguments(engine, inputs, results, 0) for engine in compiled]

        with compiling(calls) as self._until_compiled:
            yield

    def passed_through(self, inputs: BlockInputs) -> BlockResult:
        """The block as it is where it is known that nothing of it is to be removed; directions are not looked at.

        The flags of pixels that are lit, seen, and neither hidden nor too steep, as the correction gives them.
        """
        results = self._results(inputs, everywhere=inputs.image.shape, want_removed=False)
        if len(inputs.image) == 0 and inputs.low_confidence is None:
            flags = flags_of(inputs.material)
            counts = [np.count_nonzero(inputs.material == row) for row in range(len(self.names) + 1)]
            results = replace(results, flags=flags, tally=self.tally_of(np.array(counts)))
        else:
            idle = replace(self._engines[0], table=self._engines[0].table._replace(peak=np.zeros_like(self.peaks)))
            self._run(idle, inputs, results, 0)
        return self._result(inputs, results, want_removed=False)

    def tally_of(self, counts: Array) -> kernels.Tally:
        """The sums of a block of which nothing is to be removed, with so many pixels of each row."""
        tally = new_tally(len(self.names) + 1, len(self.stored.scale))
        tally.states[:, SpecularState.NEGLIGIBLE] = counts
        tally.states[0] = 0
        tally.states[0, SpecularState.NOT_ASSESSED] = counts[0]
        return tally

    def __call__(self, inputs: BlockInputs, *, first_row: int = 0, want_removed: bool = True) -> BlockResult:
        """The block without its specular part; `inputs.image` is changed in place."""
        results = self._results(inputs, everywhere=inputs.image.shape, want_removed=want_removed)
        if len(self._engines) == 1:
            self._run(self._engines[0], inputs, results, first_row)
        else:
            self._run_each(inputs, results, first_row)
        return self._result(inputs, results, want_removed=want_removed)

    def _results(self, inputs: BlockInputs, *, everywhere: tuple[int, ...], want_removed: bool) -> "_Results":
        """What the engines write into, empty."""
        nowhere = (everywhere[0], 0, 0)
        return _Results(
            removed=np.zeros(everywhere if want_removed else nowhere, self.removed_type),
            sigma=np.empty(everywhere if self.uncertainty else nowhere, np.float32),
            flags=inputs.flags(),
            tally=new_tally(len(self.names) + 1, len(self.stored.scale)),
        )

    def _result(self, inputs: BlockInputs, results: "_Results", *, want_removed: bool) -> BlockResult:
        """What they wrote, as it was asked for."""
        return BlockResult(
            corrected=inputs.image,
            removed=results.removed if want_removed else None,
            flags=results.flags,
            tally=results.tally,
            sigma=results.sigma if self.uncertainty else None,
        )

    def _run_each(self, inputs: BlockInputs, results: "_Results", first_row: int) -> None:
        """Several precisions: each engine sees the others' pixels as if they had no material."""
        known = results.flags.copy()
        for engine in self._engines:
            mine = engine.mine[inputs.material]
            own_inputs = replace(inputs, material=np.where(mine, inputs.material, np.uint8(0)))
            own = replace(results, flags=known.copy(), sigma=results.sigma.copy())
            self._run(engine, own_inputs, own, first_row)
            take = mine | (inputs.material == 0)
            results.flags[take] = own.flags[take]
            if self.uncertainty:
                results.sigma[:, take] = own.sigma[:, take]
        results.tally.states[0] = 0, 0, 0, np.count_nonzero(inputs.material == 0)

    def _run(self, engine: _Engine, inputs: BlockInputs, results: "_Results", first_row: int) -> None:
        arguments = self._arguments(engine, inputs, results, first_row)
        if engine.precision == "reference":
            oracle.correct_block(*arguments)
        else:
            self._until_compiled()
            kernels.correct_block(*arguments)

    def _arguments(self, engine: _Engine, inputs: BlockInputs, results: "_Results", first_row: int) -> tuple[Any, ...]:
        """Of the engine's `correct_block`."""
        real = np.float32 if engine.precision == "fast" else np.float64
        block = (
            inputs.image,
            results.removed,
            results.flags,
            np.ascontiguousarray(inputs.material),
            np.ascontiguousarray(inputs.sun, np.float64),
            np.ascontiguousarray(inputs.view, np.float64),
            _vectors(inputs.normal, engine.precision),
            engine.table,
            self._pixels[np.dtype(real)],
            results.tally,
        )
        options = np.array([self.skip, first_row, self.tally_stride], dtype=np.int64)
        extras = None if engine.extras is None else _of_block(engine.extras, inputs, results.sigma)
        if engine.precision == "reference":
            return *block, options, extras
        scratch = kernels.new_scratch(len(inputs.image), real)
        equations = True if engine.precision == "exact" else None
        return *block, scratch, equations, options, extras


@dataclass(frozen=True, slots=True)
class _Results:
    """What the engines write into."""

    removed: Array
    sigma: Array
    """of no rows where it is not asked for, as is `removed`"""
    flags: Array
    tally: kernels.Tally


def _of_block(extras: kernels.Extras, inputs: BlockInputs, sigma: Array) -> kernels.Extras:
    """The extras with the fields of one block."""
    fields: dict[str, Any] = {"sigma": sigma}
    if inputs.weight is not None:
        fields["weight"] = np.ascontiguousarray(inputs.weight, np.float32)
    if inputs.normal_sigma_deg is not None:
        fields["scatter"] = np.ascontiguousarray(inputs.normal_sigma_deg, np.float32)
    return extras._replace(**fields)


def _vectors(values: Array, precision: str) -> Array:
    """Contiguous vectors; those in float32 are widened where they are read, by compiled code alone."""
    as_they_are = values.dtype == np.float32 and precision != "reference"
    return np.ascontiguousarray(values, None if as_they_are else np.float64)


def flags_of(material: Array) -> Array:
    """The flags of a block of which nothing is to be removed, by the corrector's row of each pixel: uint16."""
    return np.where(material == 0, np.uint16(UNKNOWN_MATERIAL), np.uint16(0))


def looked_up(values: Array, table: bytes) -> Array:
    """The entry of a table of 256 for each value, uint8; in half the time of indexing."""
    found = bytearray(np.ascontiguousarray(values)).translate(table)
    return np.frombuffer(found, np.uint8).reshape(values.shape)


def class_rows(classes: Array, rows: Mapping[int, int]) -> Array:
    """The corrector's row of each pixel of a class map: uint8, 0 where the class has no material."""
    if classes.dtype.kind not in "iu":
        raise InputError(f"a class map holds {classes.dtype} values; allowed are integers")
    if classes.dtype == np.uint8:
        table = bytearray(256)
        for value, row in rows.items():
            if 0 <= value < len(table):
                table[value] = row
        return looked_up(classes, bytes(table))
    result = np.zeros(classes.shape, np.uint8)
    for value, row in rows.items():
        result[classes == value] = row
    return result
