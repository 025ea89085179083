"""The specular peak taken out of a block of an image: pure arrays in, arrays and flags out."""

from tscorr.correction.corrector import UNKNOWN_MATERIAL, BlockInputs, BlockResult, Corrector, class_rows, flags_of
from tscorr.correction.extras import check_ratio, is_extra
from tscorr.correction.flags import FLAG_VALUES, SINGLE_FLAGS, PixelFlag, SpecularState, specular_state
from tscorr.correction.rules import NEGLIGIBLE_REFLECTANCE, ReferenceDirections, Rules, Stored
from tscorr.correction.tables import Entry, add_angles, add_tally, new_tally, steepest_deg

__all__ = [
    "FLAG_VALUES",
    "NEGLIGIBLE_REFLECTANCE",
    "SINGLE_FLAGS",
    "UNKNOWN_MATERIAL",
    "BlockInputs",
    "BlockResult",
    "Corrector",
    "Entry",
    "PixelFlag",
    "ReferenceDirections",
    "Rules",
    "SpecularState",
    "Stored",
    "add_angles",
    "add_tally",
    "check_ratio",
    "class_rows",
    "flags_of",
    "is_extra",
    "new_tally",
    "specular_state",
    "steepest_deg",
]
