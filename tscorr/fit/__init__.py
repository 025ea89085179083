"""Fit the Torrance-Sparrow model to goniometer measurements: a `Material` with its errors.

`fit_brdf` takes arrays, `fit_files` files. The floor of each module is that of this folder; inside it

    measurements  →  readers, noise, solver  →  result  →  advice, summary, plots  →  fitting  →  files
"""

from tscorr.fit.files import FittedFiles, fit_files
from tscorr.fit.fitting import FitSettings, fit_brdf, fit_measurements
from tscorr.fit.library import materials_toml, save_materials
from tscorr.fit.measurements import Measurements, Selection
from tscorr.fit.readers import read_measurements
from tscorr.fit.result import Bootstrap, FitResult

__all__ = [
    "Bootstrap",
    "FitResult",
    "FitSettings",
    "FittedFiles",
    "Measurements",
    "Selection",
    "fit_brdf",
    "fit_files",
    "fit_measurements",
    "materials_toml",
    "read_measurements",
    "save_materials",
]
