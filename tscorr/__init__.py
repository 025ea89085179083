"""Remove the specular peak of man-made surfaces from airborne images of cities."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from tscorr.api import CorrectionResult, brdf, correct
    from tscorr.batch import BatchResult, run
    from tscorr.correction import PixelFlag, Rules, SpecularState, specular_state
    from tscorr.errors import TscorrError
    from tscorr.fit import FitResult, fit_brdf
    from tscorr.materials import Material, load_materials, material
    from tscorr.width import azimuthal_width

_HOMES = {
    "api": ("CorrectionResult", "brdf", "correct"),
    "batch": ("BatchResult", "run"),
    "correction": ("PixelFlag", "Rules", "SpecularState", "specular_state"),
    "errors": ("TscorrError",),
    "fit": ("FitResult", "fit_brdf"),
    "materials": ("Material", "load_materials", "material"),
    "width": ("azimuthal_width",),
}
_HOME = {name: module for module, names in _HOMES.items() for name in names}

__all__ = [
    "BatchResult",
    "CorrectionResult",
    "FitResult",
    "Material",
    "PixelFlag",
    "Rules",
    "SpecularState",
    "TscorrError",
    "azimuthal_width",
    "brdf",
    "correct",
    "fit_brdf",
    "load_materials",
    "material",
    "run",
    "specular_state",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for: `import tscorr` itself is instant."""
    if name not in _HOME:
        raise AttributeError(f"module 'tscorr' has no attribute '{name}'")
    return getattr(import_module(f"tscorr.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    """The public names, imported or not, so that completion finds them."""
    return sorted({*globals(), *__all__})
