"""What a fit to scenes gives back: a material, its errors, and how far to believe them."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tscorr.fit.images import ImageSamples
from tscorr.fit.solver import BOUNDS, normal_incidence
from tscorr.materials import Material

Array = NDArray[np.float64]

SIGNIFICANT = 3.0  # sigma
MISFIT = 5.0  # typical residuals beyond which a sample is not explained
MANY_MISFITS = 0.2
IN_LOBE = 1.5  # of w alpha: a tenth of the peak
MISFITS_IN_LOBE = 0.4, 2.0  # share there, and times the share elsewhere, from which the normals are suspected
NEAR_PEAK = 0.5  # of w alpha: 78 % of the peak
FEW_ROOFS = 10
SEPARABLE = 0.2  # relative error of t1, above which n is not told from t1


@dataclass(frozen=True, slots=True)
class SceneFit:
    """A material fitted to images."""

    material: Material
    covariance: Array
    """of t0 of each band, t1, w, n, from the scatter between roofs: it does not know of errors that all roofs have
    in common, like those of a wrong k or of noisy normals; nan where it cannot be computed"""
    t1_f0: float
    """t1 F0, the strength of the lobe at normal incidence: better known than t1"""
    t1_f0_sigma: float
    samples: ImageSamples
    residual: Array
    """(samples,) root mean square over the bands, in units of the typical one"""
    scatter: float
    """the typical residual in units of 0.0005 + 0.003 R"""
    converged: bool

    @classmethod
    def of(
        cls,
        *,
        samples: ImageSamples,
        x: Array,
        covariance: Array,
        k: float,
        form: str,
        residual: Array,
        scatter: float,
        converged: bool,
    ) -> "SceneFit":
        """From the solver's parameters x = t0 of each band, p = t1 F0, w, n, and their covariance."""
        bands = len(samples.reflectance_factor)
        p, w, n = x[bands:].tolist()
        f0, f0_by_n, _ = normal_incidence(np.asarray(n), np.asarray(k))
        change = np.eye(len(x))  # d(t0, t1, w, n) / d(t0, p, w, n)
        change[bands, bands], change[bands, bands + 2] = 1 / f0, -p * f0_by_n / f0**2
        physical = change @ covariance @ change.T
        middle = [bands // 2, bands, bands + 1, bands + 2]
        block = physical[np.ix_(middle, middle)]
        material = Material(
            name=samples.name,
            t0=tuple(x[:bands].tolist()),
            t1=(float(p / f0),),
            w=(w,),
            n=(n,),
            k=(k,),
            wavelength_um=samples.wavelength_um,
            source=f"tscorr fit of scenes {samples.source}: {form} model, {samples.roofs} roofs",
            covariance=tuple(map(tuple, block.tolist())) if np.isfinite(block).all() else (),
            zenith_range_deg=(0.0, float(np.ceil(samples.zenith_deg.max()))),
        )
        return cls(
            material=material,
            covariance=physical,
            t1_f0=p,
            t1_f0_sigma=float(np.sqrt(covariance[bands, bands])),
            samples=samples,
            residual=residual,
            scatter=scatter,
            converged=converged,
        )

    @property
    def sigma(self) -> Array:
        """1 sigma of t0 of each band, t1, w, n."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is doubtful, and what to do about it."""
        return tuple(self._advice())

    def _advice(self) -> Iterator[str]:
        material, tilt = self.material, np.rad2deg(self.samples.geometry.alpha)
        w, n = material.w[0], material.n[0]
        if not self.converged:
            yield "the fit did not settle: do not use it"
        if self.samples.roofs < FEW_ROOFS:
            yield f"seen in {self.samples.roofs} places only: the errors are themselves unsure; add scenes"
        if not self.t1_f0 > SIGNIFICANT * self.t1_f0_sigma:
            yield (
                f"no peak stands out (t1 F0 = {self.t1_f0:.2g} +- {self.t1_f0_sigma:.2g}): set t1 = 0, or add scenes "
                f"that look towards the sun's mirror image"
            )
        if tilt.min() > NEAR_PEAK / w:
            yield (
                f"no sample near the peak: the smallest facet tilt is {tilt.min():.2g} degrees, the half-width of the "
                f"lobe {np.sqrt(np.log(2)) / w:.2g}; add scenes that look closer to the sun's mirror image"
            )
        for name, value in (("w", w), ("n", n)):
            low, high = BOUNDS[name]
            if not low * 1.01 < value < high * 0.99:
                yield f"{name} = {value:.3g} is at the end of its range, {low:g} to {high:g}: do not use it"
        if self.sigma[-3] > SEPARABLE * material.t1[0]:
            yield "t1 and n are not separable here: rely on t1 F0 and w; add scenes with other directions"
        yield from self._misfits(w * tilt < IN_LOBE)

    def _misfits(self, in_lobe: NDArray[np.bool_]) -> Iterator[str]:
        misfit = self.residual > MISFIT
        inside, outside = (float(misfit[part].mean()) if part.any() else 0.0 for part in (in_lobe, ~in_lobe))
        least, times = MISFITS_IN_LOBE
        if inside > least and inside > times * outside:
            yield (
                f"{inside:.0%} of the samples in the peak do not fit, {outside:.0%} of the others: the normals err by "
                f"a good part of the lobe's width, which changes w and t1 F0 by more than their errors say; take "
                f"surface kind roof_planes, or normals with less noise"
            )
        elif misfit.mean() > MANY_MISFITS:
            yield f"{misfit.mean():.0%} of the samples do not fit: look at the class map, shadows and co-registration"

    def summary(self) -> str:
        """The result as text, for the terminal."""
        material, sigma, samples = self.material, self.sigma, self.samples
        wavelengths = material.wavelength_um or (float("nan"),)
        t0 = "  ".join(
            f"{um:.3g} um {value:.4g} +- {error:.2g}"
            for um, value, error in zip(wavelengths, material.t0, sigma, strict=False)
        )
        lobe = "  ".join(
            f"{name} {value:.4g} +- {error:.2g}"
            for name, value, error in (
                *(
                    (name, getattr(material, name)[0], sigma[place])
                    for name, place in (("t1", -3), ("w", -2), ("n", -1))
                ),
                ("t1 F0", self.t1_f0, self.t1_f0_sigma),
            )
        )
        tilt = np.rad2deg(samples.geometry.alpha)
        seen = (
            f"  {len(samples)} samples, facet tilt {tilt.min():.1f} to {tilt.max():.1f} degrees; "
            f"{np.mean(self.residual > MISFIT):.1%} of them do not fit; k is held at {material.k[0]:g}"
        )
        lines = [
            f"{material.name}: {material.source}",
            seen,
            f"  {lobe}",
            f"  t0: {t0}",
            *(f"  ! {warning}" for warning in self.warnings),
        ]
        return "\n".join(lines)
