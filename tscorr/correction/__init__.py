"""The specular peak taken out of a block of an image: pure arrays in, arrays and flags out."""

from tscorr.correction.corrector import BlockInputs, BlockResult, Corrector, class_rows
from tscorr.correction.flags import SINGLE_FLAGS, PixelFlag, SpecularState, specular_state
from tscorr.correction.rules import NEGLIGIBLE_REFLECTANCE, Rules, Stored
from tscorr.correction.tables import add_tally, new_tally

__all__ = [
    "NEGLIGIBLE_REFLECTANCE",
    "SINGLE_FLAGS",
    "BlockInputs",
    "BlockResult",
    "Corrector",
    "PixelFlag",
    "Rules",
    "SpecularState",
    "Stored",
    "add_tally",
    "class_rows",
    "new_tally",
    "specular_state",
]
