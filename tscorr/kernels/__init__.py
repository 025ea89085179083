"""The fast arithmetic: twins of `reference.py` and `correction/oracle.py`, the one loop that a run spends its time in.

The equations take scalars and unit vectors as tuples of three, and are float64 where their arguments are.
`correct_block` works on chunks of a row, all materials at once, in place, as a list of steps: each a small
function with one loop. Their rules: unit-stride loops over the chunk's scratch memory, which LLVM vectorises since
it sees that lines of one array do not overlap; no index whose sign LLVM cannot tell (`line[start + j]`: pass a slice
instead); constants of the width of the data; no fastmath, so nan keeps its meaning and every instruction set gives
the same bits; polynomials instead of library calls. A step allocates nothing and is called from compiled code only,
which spares half of its compilation.

Compiled once for tables of float32 (`precision = "fast"`) and once for float64 ("exact"). Directions are float64 in
both: near grazing, where sun and view nearly cancel, float32 would lose the facet tilt.
This folder imports nothing of ours from outside: only edits within it make numba compile again (`stamp`).
"""

from tscorr.kernels.block import correct_block
from tscorr.kernels.equations import attenuation, facet_distribution, fresnel, geometry, specular
from tscorr.kernels.layout import (
    BLANK,
    FRESNEL_DEGREE,
    KEEP,
    LEAN_DEGREE,
    LEVEL,
    RATIO,
    REFERENCE,
    SIMPLIFIED,
    SKY_DEGREE,
    SUBTRACT,
    VARIANCE_DEGREE,
)
from tscorr.kernels.tables import Extras, MaterialTable, PixelRules, Scratch, Tally, new_scratch

__all__ = [
    "BLANK",
    "FRESNEL_DEGREE",
    "KEEP",
    "LEAN_DEGREE",
    "LEVEL",
    "RATIO",
    "REFERENCE",
    "SIMPLIFIED",
    "SKY_DEGREE",
    "SUBTRACT",
    "VARIANCE_DEGREE",
    "Extras",
    "MaterialTable",
    "PixelRules",
    "Scratch",
    "Tally",
    "attenuation",
    "correct_block",
    "facet_distribution",
    "fresnel",
    "geometry",
    "new_scratch",
    "specular",
]
