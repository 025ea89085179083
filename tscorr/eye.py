"""What an eye sees of light: tables of colour-science, asked of a process of its own.

The package imports plots and statistics that nobody asks for here: 130 MB that a process keeps as long as it lives,
and a second. A process that answers and ends keeps them away from the images, and can do without the most of them.
"""

import json
import subprocess
import sys
import threading
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tscorr.interpreter import another

Array = NDArray[np.float64]

OPTIONAL = "matplotlib", "pandas", "networkx", "trimesh", "OpenImageIO"
"""what colour-science imports where it is installed"""
_asking = threading.Lock()
"""scenes are drawn side by side, and one question serves all"""


class Eye(NamedTuple):
    """The CIE 1931 2 degree observer under D65, and the colours of a screen."""

    wavelength_um: Array
    """(n,), every nanometre"""
    to_xyz: Array
    """(n, 3), what light that is reflected whole at a wavelength adds to X, Y and Z"""
    to_rgb: Array
    """(3, 3), from X, Y, Z to linear sRGB"""


def eye() -> Eye:
    """The tables of colour-science."""
    with _asking:
        return _asked()


def ask_ahead() -> None:
    """Have the tables fetched while other work is done; `eye` waits for them, if need be."""
    if not _asked.cache_info().currsize:
        threading.Thread(target=eye, daemon=True).start()


@cache
def _asked() -> Eye:
    """The tables, from another interpreter that finds the same packages; from this one where it has no other."""
    try:
        answer = subprocess.run(**another("tscorr.eye"), capture_output=True, check=True)
        return Eye(*map(np.array, json.loads(answer.stdout)))
    except (OSError, subprocess.CalledProcessError, ValueError):
        with np.printoptions():  # the package changes how numpy prints arrays, for everyone
            return _tables()


def _tables() -> Eye:
    import colour

    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    illuminant = colour.SDS_ILLUMINANTS["D65"]
    power = np.interp(observer.wavelengths, illuminant.wavelengths, illuminant.values)
    to_rgb: Any = colour.models.RGB_COLOURSPACE_sRGB.matrix_XYZ_to_RGB.T
    return Eye(observer.wavelengths / 1000.0, observer.values * power[:, np.newaxis], to_rgb)


if __name__ == "__main__":
    sys.modules.update(dict.fromkeys(OPTIONAL))  # type: ignore[arg-type] # what is None cannot be imported
    json.dump([table.tolist() for table in _tables()], sys.stdout)
