"""A block of an image corrected by the equations as they stand: slow, in float64, and what the kernel is held to."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tscorr.kernels import layout as bits
from tscorr.reference import (
    Geometry,
    attenuation,
    broadened,
    direction_variance,
    geometry,
    log_gradient,
    specular,
)

Array = NDArray[Any]


class _Pixels(NamedTuple):
    """The pixels of one material in a block, arrays (pixels,)."""

    row: int
    """of the tables"""
    angles: Geometry
    sun_up: Array
    up: Array
    """third components of the directions to the sun and of the normal"""
    lit: Array
    """bool: assessed, and the sun shines on it"""
    shaded: Array
    """bool: assessed for the light of the sky alone"""
    where: tuple[Array, ...]
    """place in the block"""


class _Light(NamedTuple):
    """Reflectance factors (bands, pixels) that a material would add and show."""

    direct: Array
    """pi beta c t1 f_spec: the specular part of the sun's light"""
    sky: Array
    """(1 - beta) times the albedo of the lobe: that of an even sky"""
    back: Array
    """the specular part at the reference geometry, that is added back"""
    diffuse: Array
    """pi t0 (beta c + (1 - beta) v), v the part of the sky that the facet sees"""
    diffuse_by_beta: Array

    @property
    def specular(self) -> Array:
        return self.direct + self.sky


def correct_block(
    image: Array,
    removed: Array,
    flags: Array,
    material: Array,
    sun: Array,
    view: Array,
    normal: Array,
    table: Any,
    rules: Any,
    tally: Any,
    options: Array,
    extras: Any = None,
) -> None:
    """Take the specular part out of a block of an image, in place; slow, as the equations stand, in float64.

    Arguments as in kernels.correct_block. `skip` of the options means nothing here.
    """
    stored = image.astype(np.float64)
    missing = ~np.isfinite(stored).all(axis=0)
    if rules.has_nodata:
        missing |= (image == rules.nodata[0]).any(axis=0)
    full = stored >= rules.saturation[:, None, None]
    if extras is not None and extras.sigma.shape[1]:
        reflectance = stored * rules.scale[:, None, None] + rules.offset[:, None, None]
        extras.sigma[:] = np.where(missing, np.nan, _noise(reflectance, extras.noise[:, :, None, None]))

    flags &= np.where(missing | ~table.peak[material], bits.DOUBT, bits.ON_ENTRY)
    flags[missing] |= bits.NODATA | bits.NOT_ASSESSED
    flags[~missing & (material == 0)] |= bits.NO_MATERIAL | bits.NOT_ASSESSED
    flags[~missing & full.any(axis=0)] |= bits.SATURATED

    _, first_row, stride = options
    for q in range(table.peak.size):
        where = np.nonzero((material == q) & ~missing)
        tally.states[q, 3] += np.count_nonzero((material == q) & missing)
        if not table.peak[q]:
            tally.states[q, 0 if q else 3] += where[0].size
            continue
        all_bands: Any = (slice(None), *where)
        vectors = [np.broadcast_to(v, (3, *material.shape))[all_bands].astype(float) for v in (sun, view, normal)]
        angles = geometry(*vectors)
        f = flags[where]
        has_sky = extras is not None and bool(extras.has_sky[q])
        lit, shaded = _assessable(angles, f, table, q, has_sky)
        pixels = _Pixels(q, angles, vectors[0][2], vectors[2][2], lit, shaded, where)
        light = _light(pixels, table, extras)

        values, saturated = stored[all_bands], full[all_bands]
        reflectance = values * rules.scale[:, None] + rules.offset[:, None]
        weight = _at(None if extras is None else extras.weight, where, 1.0)
        amount, above = _amount(reflectance, light, weight, q, table, extras)
        share = _share(weight * light.specular if _adds(extras, q) else amount, above, reflectance)
        hit = above.any(axis=0)
        over = hit & (saturated.any(axis=0) | (share > table.share[q]))
        f[hit & ~over] |= bits.CORRECTED
        f[over] |= bits.UNCORRECTABLE

        take = (amount != 0) & ~saturated & (~over | (not table.ways[q] & (bits.KEEP | bits.BLANK)))
        if extras is not None and extras.sigma.shape[1]:
            of_removed, noise_left = _sigma_removed(reflectance, light, weight, pixels, table, extras)
            _spread(extras.sigma, all_bands, take, of_removed, noise_left)
            f[(take & (of_removed > np.maximum(reflectance - amount, 0) / 2)).any(axis=0)] |= bits.UNCERTAIN
        new, clipped = _subtract(values, amount, rules, None if extras is None else extras.highest[0])
        f[(take & clipped).any(axis=0)] |= bits.CLIPPED
        taken = np.where(take, values - new, 0)
        taken = taken.astype(image.dtype) if image.dtype.kind == "f" else taken
        image[all_bands] = values - taken
        if removed.shape[1]:
            removed[all_bands] = taken
        if table.ways[q] & bits.BLANK:
            blank = (slice(None), where[0][over], where[1][over])
            image[blank] = rules.nodata[0]
            if extras is not None and extras.sigma.shape[1]:
                extras.sigma[blank] = np.nan
        flags[where] = f

        tally.states[q] += np.bincount((f >> 6) & 3, minlength=4)
        tallied = (first_row + where[0]) % stride == 0
        taken = taken * rules.scale[:, None]
        _tally(tally, pixels, np.asarray(hit), tallied, share, taken, bool(table.ways[q] & bits.SIMPLIFIED))


def _assessable(angles: Geometry, flags: Array, table: Any, q: int, has_sky: bool) -> tuple[Array, Array]:
    """Which pixels are assessed in the sun, and which for the sky alone; the reasons why not are set in `flags`."""
    self_shadow, behind = ~(angles.cos_i > 0), ~(angles.cos_r > 0)
    least, most = np.minimum(angles.cos_i, angles.cos_r), np.maximum(angles.cos_i, angles.cos_r)
    grazing = ~((least >= table.cos_min[q]) & (most <= table.cos_max[q])) & ~self_shadow & ~behind
    blocked = self_shadow | behind | grazing | (flags & bits.HIDDEN != 0)
    shadow = self_shadow | (flags & bits.CAST_SHADOW != 0)
    steep = ~((angles.cos_r >= table.cos_min[q]) & (angles.cos_r <= table.cos_max[q]))
    shaded = has_sky & shadow & ~behind & ~grazing & ~steep & (flags & bits.NOT_VIEWED == 0)
    flags[self_shadow] |= bits.SELF_SHADOW
    flags[behind] |= bits.NOT_VIEWED
    flags[grazing] |= bits.GRAZING
    flags[blocked & ~shaded] |= bits.NOT_ASSESSED
    return ~blocked, shaded


def _light(pixels: _Pixels, table: Any, extras: Any) -> _Light:
    """What the model says of the assessed pixels; 0 elsewhere."""
    q, angles = pixels.row, pixels.angles
    w, n, k = (getattr(table, name)[q, :, None] for name in ("w", "n", "k"))
    factor: Array | float = 1.0
    if extras is not None and extras.averaged[q]:
        w, factor = broadened(w, _scatter(pixels, extras))
    f_spec = factor * specular(angles, w, n, k, simplified=bool(table.ways[q] & bits.SIMPLIFIED))
    c = angles.cos_i / pixels.sun_up if table.ways[q] & bits.LEVEL else np.ones_like(pixels.sun_up)
    direct = np.where(pixels.lit, table.gain[q, :, None] * c * f_spec, 0)
    if extras is None:
        nothing = np.zeros_like(direct)
        return _Light(direct, nothing, nothing, nothing, nothing)
    beta, assessed = extras.beta[q, :, None], pixels.lit | pixels.shaded
    sky_view = (1 + pixels.up) / 2 if table.ways[q] & bits.LEVEL else 1.0
    of_sun, of_t0 = np.where(pixels.lit, c, 0), np.pi * extras.t0[q, :, None]
    return _Light(
        direct=direct,
        sky=np.where(assessed, (1 - beta) * _sky_albedo(angles.cos_r, extras.sky[q]), 0),
        back=np.where(pixels.lit, extras.reference[q, :, None], 0)
        + np.where(assessed, (1 - beta) * extras.reference_sky[q, :, None], 0),
        diffuse=of_t0 * (beta * of_sun + (1 - beta) * sky_view),
        diffuse_by_beta=of_t0 * (of_sun - sky_view),
    )


def _sky_albedo(cos_r: Array, polynomials: Array) -> Array:
    """t1 times the albedo of the lobe for each band (bands, pixels), from its polynomials (bands, degree + 3)."""
    x = cos_r * polynomials[:, -2, None] + polynomials[:, -1, None]
    result = np.zeros_like(x)
    for coefficients in polynomials[:, -3::-1].T:
        result = result * x + coefficients[:, None]
    return result


def _scatter(pixels: _Pixels, extras: Any) -> Array:
    """1 sigma of the normals. [deg]"""
    own = extras.own_scatter[pixels.row]
    return _at(extras.scatter, pixels.where, 0.0) if np.isnan(own) else np.full(pixels.up.shape, float(own))


def _at(field: Array | None, where: tuple[Array, ...], default: float) -> Array:
    """Values of a field at some pixels; a field of one pixel is the same everywhere."""
    if field is None or field.size == 1:
        return np.full(where[0].shape, default if field is None else float(field.ravel()[0]))
    return field[where].astype(float)


def _adds(extras: Any, q: int) -> bool:
    return extras is not None and bool(extras.method[q] == bits.REFERENCE)


def _amount(reflectance: Array, light: _Light, weight: Array, q: int, table: Any, extras: Any) -> tuple[Array, Array]:
    """What is to be taken away in each band (bands, pixels), and where that is above the threshold."""
    specular_part = weight * light.specular
    if _adds(extras, q):
        amount = weight * (light.specular - light.back)
        above = np.abs(amount) >= table.negligible[q]
    else:
        amount = specular_part
        above = specular_part >= table.negligible[q]
        if extras is not None and extras.method[q] == bits.RATIO:
            whole = light.specular + light.diffuse
            amount = np.maximum(reflectance, 0) * specular_part / np.where(whole > 0, whole, 1)
    above &= (amount != 0) if _adds(extras, q) else (specular_part > 0)
    return np.where(above, amount, 0), above


def _noise(reflectance: Array, noise: Array) -> Array:
    """1 sigma of the image, a + b R; noise (bands, 2, ...)."""
    return noise[:, 0] + noise[:, 1] * np.maximum(reflectance, 0)


def _sigma_removed(
    reflectance: Array, light: _Light, weight: Array, pixels: _Pixels, table: Any, extras: Any
) -> tuple[Array, Array]:
    """1 sigma of what is taken away, from material, directions and direct fraction; and of the image, what is left.

    (bands, pixels). First order; the sky's part is taken to err with the sun's, which is an upper bound.
    """
    q, angles = pixels.row, pixels.angles
    w, n, k = (getattr(table, name)[q, :, None] for name in ("w", "n", "k"))
    t0, t1, beta, beta_sigma = (getattr(extras, name)[q, :, None] for name in ("t0", "t1", "beta", "beta_sigma"))
    covariance, method = extras.covariance[q], extras.method[q]
    gradient = log_gradient(angles, np.where(t1 > 0, t1, np.inf), w, n, k)
    if method == bits.RATIO:
        gradient[0] -= 1 / np.where(t0 > 0, t0, np.inf)
    back = np.where(pixels.lit, extras.reference[q, :, None], 0)
    change = light.direct * gradient - back * extras.reference_gradient[q].T[:, :, None]
    of_material = np.einsum("ibp,bij,jbp->bp", change, covariance, change)
    back_albedo = extras.reference_sky[q, :, None]
    of_sky = np.abs(light.sky - (1 - beta) * back_albedo) * extras.sky_sigma[q, :, None]
    directions = direction_variance(
        angles,
        np.deg2rad(_scatter(pixels, extras)),
        np.sqrt(extras.view_variance[0]),
        simplified=bool(table.ways[q] & bits.SIMPLIFIED),
        horizontal=bool(table.ways[q] & bits.LEVEL),
    )
    albedo = _sky_albedo(angles.cos_r, extras.sky[q]) - back_albedo
    by_beta = (light.direct - back) / np.where(beta > 0, beta, 1) - albedo
    if method == bits.RATIO:  # of B D / (B + D): the derivative of B, less B / D times that of D
        by_beta = by_beta - light.specular * light.diffuse_by_beta / np.where(light.diffuse > 0, light.diffuse, 1)
    variance = (
        (np.sqrt(np.maximum(of_material, 0)) + of_sky) ** 2
        + np.where(pixels.lit, light.direct**2 * directions.at(w), 0)
        + (by_beta * beta_sigma) ** 2
    )
    sigma, left = weight * np.sqrt(variance), np.ones_like(reflectance)
    if method == bits.RATIO:
        whole = np.where(light.diffuse + light.specular > 0, light.diffuse + light.specular, 1)
        sigma = sigma * np.maximum(reflectance, 0) * light.diffuse / whole**2
        left = 1 - weight * light.specular / whole
    return sigma, left * _noise(reflectance, extras.noise[:, :, None])


def _spread(sigma: Array, place: Any, take: Array, of_removed: Array, noise_left: Array) -> None:
    """1 sigma of the corrected value, where something was taken."""
    sigma[place] = np.where(take, np.hypot(noise_left, of_removed), sigma[place])


def _share(amount: Array, above: Array, reflectance: Array) -> Array:
    """The largest share of the signal over the bands; 2 where there is something to take and no signal."""
    lit = reflectance > 0
    return np.where(above, np.where(lit, amount / np.where(lit, reflectance, 1), 2.0), 0).max(axis=0)


def _subtract(values: Array, amount: Array, rules: Any, highest: float | None) -> tuple[Array, Array]:
    """Stored values less the amount, rounded to stored steps and held in their range; and where they were held."""
    steps = amount * rules.steps[:, None]
    new = values - (np.floor(steps + 0.5) if rules.integer else steps.astype(rules.nodata.dtype))
    lowest = rules.lowest[:, None]
    low = new < lowest
    new = np.where(low, np.minimum(values, lowest), new)
    high = np.zeros_like(low) if highest is None else new > np.maximum(values, highest)
    new = np.where(high, np.maximum(values, highest if highest is not None else 0), new)
    dodge = rules.dodge & (new == rules.nodata[0])
    return np.where(dodge, new + 1, new), low | high | dodge


def _tally(
    tally: Any, pixels: _Pixels, hit: Array, tallied: Array, share: Array, taken: Array, simplified: bool
) -> None:
    """The sums for the report, as kernels.Tally describes them."""
    q, angles = pixels.row, pixels.angles
    g = np.where(pixels.lit, attenuation(angles.cos_i, angles.cos_r, angles.cos_l), 1)
    tally.attenuated[0] += np.count_nonzero(g < 1)
    of = pixels.lit & tallied
    incidence, tilt = (
        np.rad2deg(np.arctan2(np.sqrt(1 - angles.cos_i[of] ** 2), angles.cos_i[of])),
        np.rad2deg(angles.alpha[of]),
    )
    np.add.at(tally.incidence[q], np.minimum(359, incidence * 4).astype(int), 1)
    np.add.at(tally.tilt[q], np.minimum(899, tilt * 10).astype(int), 1)
    tally.extremes[q, 0] = min(tally.extremes[q, 0], tilt.min(initial=np.inf))
    of = hit & tallied
    part = np.minimum(1, share[of])
    np.add.at(tally.share[q], (part * 200).astype(int), 1)
    tally.extremes[q, 1] = max(tally.extremes[q, 1], part.max(initial=0))
    tally.removed[q] += np.floor(taken[:, of] * 2.0**32 + 0.5).astype(np.int64).sum(axis=1)
    change = 1 - g[of] if simplified else 1 / g[of] - 1
    tally.attenuated[1] = max(tally.attenuated[1], (part * change).max(initial=0))
