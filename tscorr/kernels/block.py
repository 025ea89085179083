"""The one loop that a run spends its time in: the steps of `correct_block`, chunk by chunk."""

import numpy as np
from numba import njit

from tscorr.kernels.layout import BLOCK, CHUNK, NORMAL, SUN, VIEW
from tscorr.kernels.lobe import set_amounts, set_shape
from tscorr.kernels.methods import assess_shaded, exchange, set_extras, weigh_any
from tscorr.kernels.pixels import aim, assess, list_kinds, load, look, mark_known, set_cosines, set_rules
from tscorr.kernels.spread import set_sigma
from tscorr.kernels.stamp import SOURCES
from tscorr.kernels.tallies import count_states, tally_geometry, tally_removed
from tscorr.kernels.values import blank_out, clear, keep, set_share, settle, store, subtract, weigh


@njit(cache=True, **BLOCK)
def correct_block(
    image, removed, flags, material, sun, view, normal, table, rules, tally, scratch, equations, options, extras=None,
    sources=SOURCES,  # noqa: ARG001 - so that numba compiles again when a step is edited
):  # fmt: skip
    """Take the specular part out of a block of an image, in place. Twin of correction.oracle.correct_block.

    image    : (bands, rows, cols), stored values; changed in place.
    removed  : the same shape and type, zeros on entry: what was taken away. Or of no rows: not wanted.
    flags    : uint16 (rows, cols). On entry CAST_SHADOW, NOT_VIEWED, NORMAL_UNRELIABLE, LOW_CONFIDENCE where
               they hold; on exit all bits of PixelFlag. Those of the geometry are cleared where no material has a
               peak and where there are no data, since there nobody looks.
    material : uint8 (rows, cols), rows of `table`; 0 is no material.
    sun, view, normal : unit vectors, float64 (3, rows, cols), or (3, 1, 1) where constant; `normal` also float32.
    equations : True: the equations themselves at each pixel, in float64; or None: polynomials stand in for them, and
               the equations are not even compiled.
    options  : int64 (3,): skip, first row of the block in the image, tally every so many rows.
    extras   : Extras; or None: plain subtraction of the sun's part, and nothing more is compiled.
    sources  : never given.
    """
    bands, rows, cols = image.shape
    skip, first_row, stride = options[0] != 0, options[1], options[2]
    aims, real, whole, amounts, present = scratch.aims, scratch.real, scratch.whole, scratch.amounts, scratch.present
    nodata = rules.nodata[0]
    for row in range(rows):
        tallied = (first_row + row) % stride == 0
        for start in range(0, cols, CHUNK):
            stop = min(start + CHUNK, cols)
            count, marks = stop - start, flags[row, start:stop]

            # Which materials there are, and whether the geometry lets them be assessed.
            load(material[row, start:stop], marks, whole)
            for b in range(bands):
                look(image[b, row, start:stop], rules, b, nodata, whole)
            kinds, peaks = list_kinds(whole, count, table.peak, present)
            for place in range(peaks):
                set_rules(whole, real, table, present[place])
            mark_known(whole)
            assessed, hits, blanks = 0, 0, 0
            if peaks > 0:
                aim(sun, row, start, stop, aims[SUN:VIEW])
                aim(view, row, start, stop, aims[VIEW:NORMAL])
                aim(normal, row, start, stop, aims[NORMAL:])
                set_cosines(aims, real)
                assessed = assess(whole, real)
            plain = True
            if extras is not None:
                plain = set_extras(scratch, extras, peaks, row, start, stop)
                assessed += 0 if plain else assess_shaded(whole, real)

            # What is to be removed, and what becomes of each pixel.
            inside = assessed > 0
            if inside:
                tally.attenuated[0] += set_shape(whole, real)
                inside = set_amounts(scratch, table, peaks, skip, equations, extras)
                tally.out_of_lobe[0] += 0 if inside else assessed
            if inside:
                clear(whole, real)
                if plain:
                    for b in range(bands):
                        weigh(amounts[b], image[b, row, start:stop], rules.scale[b], rules.offset[b], whole, real)
                if extras is not None:
                    for b in range(0 if plain else bands):
                        weigh_any(scratch, extras, peaks, image[b, row, start:stop], rules, b)
                hits, blanks = settle(whole)
            if extras is not None and extras.sigma.shape[1] > 0:
                set_sigma(scratch, table, extras, peaks, hits, plain, image, row, start, stop, rules)
            for b in range(bands if hits > 0 else 0):
                line = image[b, row, start:stop]
                if tallied and plain:
                    set_share(amounts[b], line, rules.scale[b], rules.offset[b], real)
                if plain:
                    subtract(amounts[b], line, rules, b, whole, real)
                elif extras is not None:
                    exchange(amounts[b], line, rules, b, extras.highest[0], whole, real)
                if removed.shape[1] > 0:
                    keep(amounts[b], removed[b, row, start:stop], whole)
            for b in range(bands if blanks > 0 else 0):
                blank_out(image[b, row, start:stop], nodata, whole)
                if extras is not None and extras.sigma.shape[1] > 0:
                    blank_out(extras.sigma[b, row, start:stop], np.float32(np.nan), whole)

            store(marks, whole)
            for place in range(kinds):
                count_states(whole, np.int32(present[place]), count, tally.states)
            if tallied and assessed > 0:
                tally_geometry(whole, real, count, tally)
            if tallied and hits > 0:
                tally_removed(whole, real, amounts, count, rules.scale, tally)
