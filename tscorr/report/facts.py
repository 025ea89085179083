"""What a run knows about a scene when it is done."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tscorr.materials import BandParameters, Material
from tscorr.width import LobeShape, typical_lobe

if TYPE_CHECKING:
    from tscorr.correction import Rules
    from tscorr.correction.sigmas import SigmaTally
    from tscorr.kernels import Tally

Array = NDArray[Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneFacts:
    """Sums over the blocks of a scene, and its settings. Azimuths are from true north.

    tally holds every pixel of the image once in `states`: also those of blocks that were skipped.
    """

    scene: str
    image: str
    """file name"""
    bands: tuple[str, ...]
    """names"""
    wavelengths_um: tuple[float, ...]
    """band centres, nan where unknown"""
    materials: Sequence[tuple[Material, BandParameters, "Rules"]]
    """in the order of the tally's rows, from row 1"""

    tally: "Tally"
    tally_stride: int
    """histograms and extremes are of every so many rows of the image; counts are of all"""
    flag_counts: Mapping[str, int]
    """pixels by name of `PixelFlag`"""
    skipped: Mapping[str, int]
    """blocks, blocks_no_specular_material, blocks_out_of_reach, blocks_shadow_or_nodata"""
    uncertainty_evaluated: bool
    """whether anyone looked for UNCERTAIN"""

    solar_zenith_deg: float
    solar_azimuth_deg: float
    convergence_deg: float
    """of the grid: azimuth from true north less azimuth from grid north"""
    sun_at: Callable[[Array], tuple[Array, Array]] | None
    """solar zenith and azimuth [deg] so many minutes later (n,); None where the sun was given as angles"""

    view_zenith_deg: Array
    view_azimuth_deg: Array
    relative_azimuth_deg: Array
    """samples of the scene's view directions about the vertical, of one shape, nan where not viewed"""
    centre_view_deg: tuple[float, float] | None
    """zenith and azimuth of the view direction at the scene's centre"""
    camera_height_m: float | None = None
    """of a frame camera above the ground; None for other sensors"""

    seconds: Mapping[str, float]
    """wall, read, geometry, kernel, write"""
    peak_rss_mb: float
    version: str
    """of tscorr"""
    sigmas: "SigmaTally | None" = None
    """how sure the corrected values are; None where nobody asked"""

    def lobe(self, row: int) -> LobeShape:
        """The lobe that stands for a material in widths and plots."""
        return typical_lobe(self.materials[row][1])

    def views(self) -> tuple[Array, Array, Array]:
        """View zenith, view azimuth and relative azimuth of the finite samples, flat. [deg]"""
        samples = [
            np.asarray(a, dtype=float).ravel()
            for a in (self.view_zenith_deg, self.view_azimuth_deg, self.relative_azimuth_deg)
        ]
        finite = np.isfinite(samples).all(axis=0)
        zenith, azimuth, relative = (sample[finite] for sample in samples)
        return zenith, azimuth, relative
