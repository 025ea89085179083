"""The functions for notebooks: arrays in, arrays out."""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from tscorr import reference
from tscorr.correction import BlockInputs, Corrector, Entry, Rules, Stored, check_ratio, class_rows
from tscorr.errors import InputError, Limits, check_values
from tscorr.materials import ALLOWED_WAVELENGTHS, Material, is_wavelength, material
from tscorr.width import is_simplified

Array = NDArray[Any]


def brdf(
    surface: Material | str,
    incidence_deg: ArrayLike,
    exitance_deg: ArrayLike,
    relative_azimuth_deg: ArrayLike,
    form: Literal["full", "simplified"] = "full",
    wavelength_um: float | None = None,
) -> Array:
    """Bidirectional reflectance distribution function f_r of a material; equation 1 of the paper. [sr^-1]

    surface : a `Material`, or the name of one of the built-in library.
    incidence_deg, exitance_deg : from the surface normal, 0 to below 90; nan beyond. Arrays broadcast.
    relative_azimuth_deg : 0 is back-scatter, 180 forward scatter.
    wavelength_um : needed where the material has several wavelengths.

    >>> import tscorr
    >>> float(round(tscorr.brdf("roof_tile", 50, 50, 180)[()], 6))
    0.075591
    """
    known = surface if isinstance(surface, Material) else material(surface)
    wavelengths = None if wavelength_um is None else [wavelength_um]
    _check_wavelengths(wavelengths)
    parameters = known.at(wavelengths)
    try:
        given = [np.asarray(angle, dtype=float) for angle in (incidence_deg, exitance_deg, relative_azimuth_deg)]
        incidence, exitance, azimuth = np.broadcast_arrays(*given)
    except (TypeError, ValueError) as error:
        raise InputError(f"incidence, exitance and relative azimuth: {error}; allowed are numbers [degrees]") from None
    upright = np.where((incidence >= 0) & (exitance >= 0), 0.0, np.nan)
    geometry = reference.geometry_from_angles(incidence + upright, exitance, azimuth)
    t0, t1, w, n, k = (getattr(parameters, name)[0] for name in ("t0", "t1", "w", "n", "k"))
    f_spec = reference.specular(geometry, w, n, k, simplified=is_simplified(form))
    return reference.brdf(f_spec, t0, t1)


@dataclass(frozen=True, slots=True)
class CorrectionResult:
    """What `correct` returns.

    corrected, removed : (bands, rows, cols), of the type of the input; input - removed = corrected.
    flags : uint16 (rows, cols), bits of `PixelFlag`.
    sigma : float32, of the shape of `corrected`: 1 sigma of the corrected reflectance factor; None if not asked for.
    Arrays of numpy, or of xarray where the image was one. With method = "reference" `removed` of an unsigned image
    is of a signed type, since it can be negative.
    """

    corrected: Array
    removed: Array
    flags: Array
    sigma: Array | None = None


NUMBERS: Limits = {
    "scale": (lambda value: 0 < value < np.inf, "a number above 0"),
    "offset": (np.isfinite, "a number"),
    "nodata": (lambda value: value is None or isinstance(value, Real), "a number"),
    "saturation": (lambda value: value is None or not np.isnan(value), "a number"),
    "image_noise": (lambda value: len(value) == 2 and min(value) >= 0, "a, b, none below 0"),
    "direction_sigma_deg": (lambda value: 0 <= value <= 45, "an angle from 0 to 45"),
}
"""what the numbers that `correct` takes may be"""


def correct(
    reflectance_factor: ArrayLike,
    classes: ArrayLike,
    materials: Mapping[int, Material | str],
    sun: ArrayLike,
    view: ArrayLike,
    normal: ArrayLike | None = None,
    *,
    shadowed: ArrayLike | None = None,
    hidden: ArrayLike | None = None,
    weight: ArrayLike | None = None,
    wavelength_um: Sequence[float] | None = None,
    scale: float = 1.0,
    offset: float = 0.0,
    nodata: float | None = None,
    saturation: float | None = None,
    rules: Rules | None = None,
    uncertainty: bool = False,
    image_noise: tuple[float, float] = (0.0, 0.0),
    normal_sigma_deg: ArrayLike | None = None,
    direction_sigma_deg: float = 0.0,
    skip: bool = True,
) -> CorrectionResult:
    """An image without its specular part.

    reflectance_factor : (bands, rows, cols) or (rows, cols), of which scale * value + offset is taken;
                         uint8, int16, uint16 or float32, other floats are taken as float32.
    classes   : integers (rows, cols).
    materials : material, or name of a built-in one, for each class; pixels of other classes are left alone.
    sun, view, normal : unit vectors east, north, up: (3,) or (3, rows, cols); normal is up by default.
    shadowed, hidden  : bool (rows, cols), where something stands before the sun or before the sensor.
    weight    : float (rows, cols), the part of a pixel that is its material; by default all of it.
    rules     : how to correct; by default R refers to the horizontal plane and all light is direct.
    uncertainty : say how sure the result is, from the errors of the material and of `rules`, and from these:
    image_noise : a, b of 1 sigma a + b R. normal_sigma_deg, direction_sigma_deg: 1 sigma of the normal, a number or
                (rows, cols), and of the direction to the sensor, along each of two axes across them.
    Raises InputError where shapes or types do not fit, or where method = "ratio" lacks the t0 of a band. The input is
    not changed. Masked pixels have no data: nan stands there in the result, or of integers `nodata`. A DataArray of
    xarray comes back as DataArrays with its dimensions, (bands, rows, cols) or (rows, cols) in this order, and
    coordinates.

    The sun in the south and the sensor in the north, both at 40 degrees, over a tiled roof and the street beside it:

    >>> import numpy as np, tscorr
    >>> from tscorr.angles import unit_vector
    >>> image = np.full((3, 1, 2), 0.5, np.float32)
    >>> sun, view = unit_vector(40, 180), unit_vector(40, 0)
    >>> result = tscorr.correct(image, [[1, 2]], {1: "roof_tile", 2: "lambertian"}, sun, view)
    >>> result.corrected[0].round(3)
    array([[0.402, 0.5  ]], dtype=float32)
    >>> tscorr.specular_state(result.flags)  # corrected, negligible
    array([[1, 0]], dtype=uint16)
    """
    image = np.asarray(_filled(reflectance_factor, nodata))
    if image.dtype.name not in {"uint8", "int16", "uint16", "float32"}:
        if image.dtype.kind != "f":
            raise InputError(f"an image of {image.dtype}; allowed are uint8, int16, uint16 and floating point")
        image = image.astype(np.float32)
    native = image.dtype.newbyteorder("=")
    cube = np.array(image[None] if image.ndim == 2 else image, dtype=native, order="C")
    class_map = np.asarray(classes)
    if cube.ndim != 3 or class_map.shape != cube.shape[1:] or cube.shape[0] == 0:
        raise InputError(f"an image of shape {image.shape} and classes of shape {class_map.shape} do not fit")
    numbers = {"scale": scale, "offset": offset, "nodata": nodata, "saturation": saturation}
    sigmas = {"image_noise": image_noise, "direction_sigma_deg": direction_sigma_deg}
    check_values(numbers | sigmas, NUMBERS, InputError)
    fields = {"shadowed": shadowed, "hidden": hidden, "weight": weight, "normal_sigma_deg": normal_sigma_deg}
    _check_places(reflectance_factor, {"classes": classes, **fields})
    bands, shape = cube.shape[0], cube.shape[1:]
    settings = Rules() if rules is None else rules
    if not isinstance(settings, Rules) or not isinstance(materials, Mapping):
        raise InputError("materials is a mapping of classes to materials, and rules are Rules")
    _check_wavelengths(wavelength_um)
    entries = [_entry(value, given, settings, wavelength_um, bands) for value, given in materials.items()]
    stored = Stored(
        dtype=cube.dtype,
        scale=(scale,) * bands,
        offset=(offset,) * bands,
        nodata=nodata,
        saturation=None if saturation is None else (saturation,) * bands,
        noise=(image_noise,),
        direction_sigma_deg=direction_sigma_deg,
    )
    rows = class_rows(class_map, {value: row for row, value in enumerate(materials, start=1)})
    rows[np.ma.getmaskarray(classes) if isinstance(classes, np.ma.MaskedArray) else False] = 0
    sigma_shape = (1, 1) if np.ndim(np.asarray(normal_sigma_deg)) == 0 else shape
    inputs = BlockInputs(
        image=cube,
        material=rows,
        sun=_vectors("sun", sun, shape),
        view=_vectors("view", view, shape),
        normal=_vectors("normal", [0, 0, 1] if normal is None else normal, shape),
        shadowed=_field("shadowed", shadowed, shape, 1, np.bool_),
        hidden=_field("hidden", hidden, shape, 1, np.bool_),
        weight=_field("weight", weight, shape, 1),
        normal_sigma_deg=_field("normal_sigma_deg", normal_sigma_deg, sigma_shape, 45),
    )
    corrector = Corrector(entries, stored, skip=skip, uncertainty=uncertainty, weighted=weight is not None)
    result = corrector(inputs)
    assert result.removed is not None
    whole = slice(None) if image.ndim == 3 else 0
    sigma = None if result.sigma is None else result.sigma[whole]
    return _labelled(result.corrected[whole], result.removed[whole], result.flags, sigma, reflectance_factor)


def _labelled(corrected: Array, removed: Array, flags: Array, sigma: Array | None, image: Any) -> CorrectionResult:
    """The arrays with the labels of the image where that is a DataArray; nobody who has one lacks xarray."""
    xarray = sys.modules.get("xarray")
    if xarray is None or not isinstance(image, xarray.DataArray):
        return CorrectionResult(corrected, removed, flags, sigma)
    of_band = image.isel(dict.fromkeys(image.dims[:-2], 0), drop=True).drop_attrs()
    labelled_sigma = None if sigma is None else image.copy(data=sigma)
    labelled_flags = of_band.copy(data=flags)
    return CorrectionResult(image.copy(data=corrected), image.copy(data=removed), labelled_flags, labelled_sigma)


def _check_wavelengths(wavelengths_um: Sequence[float] | None) -> None:
    try:
        right = wavelengths_um is None or all(map(is_wavelength, wavelengths_um))
    except TypeError:
        right = False
    if not right:
        raise InputError(f"wavelength_um = {wavelengths_um!r}; allowed is {ALLOWED_WAVELENGTHS}, one a band")


def _filled(image: Any, nodata: float | None) -> Any:
    """Masked values as nan, or of integers as nodata."""
    if not np.ma.is_masked(image):
        return image
    if image.dtype.kind == "f":
        return image.filled(np.nan)
    if nodata is None:
        raise InputError(f"an image of {image.dtype} has masked values; give the nodata that stands for them")
    if not Stored(dtype=image.dtype, scale=(1.0,), offset=(0.0,), nodata=nodata).has_nodata:
        raise InputError(f"nodata = {nodata!r}; allowed is a value that {image.dtype} can hold")
    return image.filled(nodata)


def _check_places(image: Any, others: Mapping[str, Any]) -> None:
    """Raise InputError where DataArrays have other coordinates than the image."""
    xarray = sys.modules.get("xarray")
    if xarray is None or not isinstance(image, xarray.DataArray):
        return
    for name, other in others.items():
        for dim in image.dims[-2:] if isinstance(other, xarray.DataArray) else ():
            known = dim in other.indexes and dim in image.indexes
            if known and not other.indexes[dim].equals(image.indexes[dim]):
                raise InputError(f"{name} and the image have different coordinates {dim}; align them first")


def _entry(value: Any, given: Any, rules: Rules, wavelength_um: Sequence[float] | None, bands: int) -> Entry:
    """The material of a class and its parameters in each band."""
    surface = material(given) if isinstance(given, str) else given
    if not isinstance(value, Integral) or not isinstance(surface, Material):
        raise InputError(f"materials holds {value!r}: {given!r}; allowed is an integer: a Material, or its name")
    if rules.method == "ratio" and surface.has_peak:
        check_ratio(surface, wavelength_um, bands)
    return surface, surface.at(wavelength_um, bands), rules


def _field(
    name: str, values: ArrayLike | None, shape: tuple[int, ...], highest: float, kind: DTypeLike = np.float32
) -> Array | None:
    """Numbers from 0 on for each pixel, also where one value is given for all; None where none is."""
    if values is None:
        return None
    try:
        field = np.broadcast_to(np.asarray(values, np.float32), shape)
    except (TypeError, ValueError):
        given = np.asarray(values)
        raise InputError(
            f"{name} is {given.dtype} of the shape {given.shape}; allowed are numbers of {shape}"
        ) from None
    wrong = ~((field >= 0) & (field <= highest)) | (field.astype(kind) != field)
    if wrong.any():
        allowed = "true and false" if kind is np.bool_ else f"0 to {highest:g}"
        raise InputError(f"{name} holds {field[wrong][0]:g}; allowed is {allowed}")
    return field.astype(kind, copy=False)


def _vectors(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Array:
    vectors = np.asarray(values, dtype=float)
    if vectors.shape not in {(3,), (3, *shape)}:
        raise InputError(f"{name} has the shape {vectors.shape}; allowed are (3,) and {(3, *shape)}")
    length = np.sqrt((vectors**2).sum(axis=0))
    if length.size and np.isnan(length).all():
        raise InputError(f"{name} is nan everywhere; allowed are unit vectors east, north, up")
    if np.any(np.abs(length - 1) > 1e-3):
        raise InputError(
            f"{name} holds vectors of length {length.flat[np.nanargmax(np.abs(length - 1))]:.4g}; allowed is 1"
        )
    return vectors.reshape(3, 1, 1) if vectors.ndim == 1 else vectors
