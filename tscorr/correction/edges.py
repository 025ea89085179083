"""At the edges of shadows, where a surface model is half a pixel unsure, the image decides.

A surface model of pixel centres cannot say where inside a pixel a wall stands, so the outline of a cast shadow is
unsure by about a pixel; one sunlit pixel of a mirror-like roof taken for shadow leaves all its glare in.
In the light a pixel is several times brighter than in shadow, where only the sky shines on it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tscorr.correction.rules import Stored
from tscorr.correction.tables import Entry

Array = NDArray[Any]

LEAST_CONTRAST = 2.0
"""times that light must be brighter than shadow for an image to tell them apart"""
SAME_BAND_UM = 0.05
"""a material of one wavelength is known in bands no farther from it"""


def rim(mask: Array) -> Array:
    """Pixels with both values around them: mask (rows + 2, cols + 2) → bool (rows, cols)."""
    return dilated(mask) & dilated(~mask)


def dilated(mask: Array) -> Array:
    """Whether any of the 3 x 3 pixels is true: mask (rows + 2, cols + 2) → bool (rows, cols)."""
    rows, cols = mask.shape[0] - 2, mask.shape[1] - 2
    across = mask[:, :cols] | mask[:, 1 : cols + 1] | mask[:, 2:]
    return across[:rows] | across[1 : rows + 1] | across[2:]


@dataclass(frozen=True)
class ShadowByBrightness:
    """Tells sunlit pixels from shadowed ones by how bright they are, material by material.

    diffuse : (materials + 1, bands), pi t0 where it is known for the band, else nan.
    direct  : (materials + 1, bands), direct fraction of the irradiance.
    horizontal : bool (materials + 1,), the plane that R refers to.
    """

    diffuse: Array
    direct: Array
    horizontal: Array
    stored: Stored

    @classmethod
    def of(
        cls, materials: Sequence[Entry], stored: Stored, wavelengths_um: Sequence[float] | None
    ) -> "ShadowByBrightness":
        """For the materials of a corrector, in its order."""
        bands = len(stored.scale)
        diffuse, direct = np.full((len(materials) + 1, bands), np.nan), np.zeros((len(materials) + 1, bands))
        horizontal = np.ones(len(materials) + 1, np.bool_)
        for row, (surface, parameters, rules) in enumerate(materials, start=1):
            known = np.full(bands, len(surface.wavelength_um) > 1)
            if len(surface.wavelength_um) == 1 and wavelengths_um is not None:
                known = np.abs(np.asarray(wavelengths_um) - surface.wavelength_um[0]) <= SAME_BAND_UM
            diffuse[row] = np.where(known, np.pi * parameters.t0, np.nan)
            direct[row] = rules.direct_fraction
            horizontal[row] = rules.irradiance_plane == "horizontal"
        return cls(diffuse, direct, horizontal, stored)

    def settle(self, shadowed: Array, unsure: Array, image: Array, rows: Array, sun: Array, normal: Array) -> Array:
        """The mask `shadowed` (rows, cols) with the `unsure` pixels decided by the image where it can tell.

        image : (bands, rows, cols), stored values. rows : the corrector's row of each pixel.
        sun, normal : unit vectors (3, rows, cols) or (3, 1, 1).
        A pixel is sunlit if, in most bands, it is nearer to the diffuse level of full light than to that of the
        sky alone, on a logarithmic scale; the specular part only makes it brighter.
        """
        where = np.flatnonzero(unsure)
        if not where.size or np.isnan(self.diffuse).all():
            return shadowed
        sun, normal = (vectors.reshape(3, -1) for vectors in (sun, normal))
        sun, normal = (every[:, where] if every.shape[1] > 1 else every for every in (sun, normal))
        cos_i, sun_up, up = (sun * normal).sum(axis=0), sun[2], normal[2]
        row = rows.ravel()[where]
        plane = np.where(self.horizontal[row], np.maximum(cos_i, 0) / sun_up, 1.0)
        sky_view = np.where(self.horizontal[row], (1 + up) / 2, 1.0)
        direct, diffuse = self.direct[row].T, self.diffuse[row].T
        sky = diffuse * (1 - direct) * sky_view
        full = sky + diffuse * direct * plane
        scale, offset = np.array(self.stored.scale)[:, None], np.array(self.stored.offset)[:, None]
        seen = image.reshape(len(image), -1)[:, where] * scale + offset
        tells = full > LEAST_CONTRAST * sky  # False where t0 is not known
        bright = tells & (seen**2 * np.sign(seen) > full * sky)
        votes = tells.sum(axis=0)
        settled = shadowed.flatten()
        settled[where] = np.where(votes > 0, 2 * bright.sum(axis=0) < votes, settled[where])
        return settled.reshape(shadowed.shape)
