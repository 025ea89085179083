"""How wide the specular peak is, how far it reaches, and where it will be seen.

`azimuthal` and `zenithal` measure the peak about the facet normal, `reach` bounds it for skipping,
`summary` puts numbers together for reports. All of a lobe's size is set by w, n and k; t0 and t1 only
decide how strong it is.
"""

from tscorr.width.azimuthal import (
    WidthTable,
    azimuthal_arc,
    azimuthal_width,
    smallest_incidence,
    why_no_width,
    width_across,
    width_table,
)
from tscorr.width.lobe import LobeShape, is_simplified, lobe_shape, lobe_shapes, typical_lobe
from tscorr.width.reach import cutoff_tilt, f_spec_bound
from tscorr.width.summary import Roof, critical_roof, flank_slope, heading_table, width_rows
from tscorr.width.zenithal import crossover_incidence, peak_exitance, zenithal_width

__all__ = [
    "LobeShape",
    "Roof",
    "WidthTable",
    "azimuthal_arc",
    "azimuthal_width",
    "critical_roof",
    "crossover_incidence",
    "cutoff_tilt",
    "f_spec_bound",
    "flank_slope",
    "heading_table",
    "is_simplified",
    "lobe_shape",
    "lobe_shapes",
    "peak_exitance",
    "smallest_incidence",
    "typical_lobe",
    "why_no_width",
    "width_across",
    "width_rows",
    "width_table",
    "zenithal_width",
]
