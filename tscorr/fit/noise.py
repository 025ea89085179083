"""The error of each measured value: as given, or a share of the modelled value plus a constant.

An error proportional to the measured value gives low values more weight and biases a fit low, by about
twice the square of the relative error. Such errors, and assumed ones, are taken of the model instead.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tscorr.fit.measurements import Measurements

Array = NDArray[np.float64]

ASSUMED_SHARE = 0.04  # the lowest average error of the paper's measurements
ASSUMED_FLOOR = 1e-3
"""sr^-1, 0.3 % reflectance: keeps dark samples, where the diffuse part is never quite Lambertian, from
deciding the shape of the lobe"""

PROPORTIONAL = 0.02  # scatter of sigma / f_r below which sigma is a share of f_r
MIN_CONTRAST = 0.1  # of f_r, below which a constant sigma and a share of f_r look alike


@dataclass(frozen=True, slots=True)
class Noise:
    """Errors of f_r, fixed or following the model."""

    fixed: Array | None
    """(bands, samples), sr^-1; None: share and floor count"""
    share: float = ASSUMED_SHARE
    floor: float = ASSUMED_FLOOR
    """sr^-1"""
    assumed: bool = False
    """the source gives no sigma: only the pattern of the errors is used, their size is the scatter's"""
    remark: str = ""
    """for the user"""

    @classmethod
    def of(cls, measured: Measurements) -> "Noise":
        """The errors of measurements."""
        sigma, f_r = measured.sigma, measured.f_r
        if sigma is None:
            return cls(
                fixed=None,
                assumed=True,
                remark=f"sigma is missing: {ASSUMED_SHARE:.0%} of f_r and {ASSUMED_FLOOR:g} sr^-1 are "
                f"assumed, and the errors scaled to the scatter; where the model does not fit, w and t1 "
                f"depend on this: give sigma",
            )
        seen = np.isfinite(f_r) & (f_r > 0)
        if not seen.any() or np.ptp(f_r[seen]) < MIN_CONTRAST * np.max(f_r[seen]):
            return cls(fixed=sigma)
        ratio = sigma[seen] / f_r[seen]
        share = float(np.median(ratio))
        if np.std(ratio) > PROPORTIONAL * share:
            return cls(fixed=sigma)
        return cls(
            fixed=None,
            share=share,
            floor=1e-6 * float(np.max(f_r[seen])),
            remark=f"sigma is {share:.2g} of each measured value, which would bias the fit low: the same "
            f"share of the fitted value is taken",
        )

    def at(self, f_r: Array) -> Array:
        """1 sigma where the model, or a first guess of it, is `f_r`."""
        return self.fixed if self.fixed is not None else np.hypot(self.share * f_r, self.floor)
