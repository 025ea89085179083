"""Previews: bands to colours, and one picture of before, after and flags.

The only module that knows OpenImageIO, which is imported where it is used; `eye` knows colour-science.

Bands become colours by one (bands, 3) matrix, in linear light: true colour through the CIE 1931 2 degree
observer under D65, near-infrared false colour, or, where wavelengths are unknown, the first bands as they
come. Images are expected decimated; `linear_rgb` takes bands one by one, so a reader need not hold them all.
"""

from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tscorr.errors import InputError, OutputError
from tscorr.eye import ask_ahead, eye
from tscorr.materials import ALLOWED_WAVELENGTHS, is_wavelength

Array = NDArray[np.float32]
Style = Literal["true_colour", "false_colour"]

VISIBLE_UM = (0.38, 0.78)
FALSE_COLOUR_UM = {"near-infrared": (0.75, 1.00), "red": (0.60, 0.70), "green": (0.50, 0.60)}
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # of linear sRGB, IEC 61966-2-1
NO_DATA_GREY = 0.5

# Colours of Okabe & Ito (2008), told apart with any colour vision.
FLAG_COLOURS = {
    "nothing to remove": (208, 208, 208),
    "corrected": (0, 158, 115),
    "uncorrectable": (213, 94, 0),
    "in shadow": (0, 114, 178),
    "not viewed, grazing": (86, 180, 233),
    "no material": (204, 121, 167),
    "no data": (0, 0, 0),
}


def rgb_matrix(wavelengths_um: ArrayLike, fwhm_um: ArrayLike | None = None, style: Style = "true_colour") -> Array:
    """Weights (bands, 3) of the bands in linear sRGB; each column sums to 1, so grey stays grey.

    `wavelengths_um` (bands,) are centres, nan where unknown: if none is visible, the first three bands are
    red, green and blue, or the first is grey. `fwhm_um` (bands,) are widths, nan or 0 where unknown: such a
    band reaches half way to its neighbours. In "false_colour" near-infrared, red and green become red, green
    and blue. InputError: centres that cannot be micrometres, or false colour without the bands for it.
    """
    centres = np.atleast_1d(np.asarray(wavelengths_um, dtype=float))
    widths = np.full(centres.shape, np.nan) if fwhm_um is None else np.atleast_1d(np.asarray(fwhm_um, float))
    if widths.shape != centres.shape:
        raise InputError(f"{widths.size} band widths for {centres.size} wavelengths; one a band is needed")
    strange = centres[~(np.isnan(centres) | is_wavelength(centres))]
    if strange.size:
        raise InputError(f"band wavelength {strange[0]:g} um; allowed is {ALLOWED_WAVELENGTHS}")
    matrix = np.zeros((centres.size, 3))
    shown = shown_bands(centres)
    if style == "false_colour":
        matrix[_false_colour_bands(centres), [0, 1, 2]] = 1.0
    elif _visible(centres).any():
        matrix[shown] = _true_colour_matrix(centres[shown], widths[shown])
    else:
        matrix[shown if len(shown) == 3 else shown * 3, [0, 1, 2]] = 1.0
    return matrix.astype(np.float32)


def prepare(wavelengths_um: ArrayLike) -> None:
    """Have what is slow to come for a picture of these bands fetched meanwhile."""
    if _visible(np.atleast_1d(np.asarray(wavelengths_um, dtype=float))).any():
        ask_ahead()


def shown_bands(wavelengths_um: ArrayLike) -> list[int]:
    """Indices of the bands that true colour can show: the visible ones, else the first three, or the first as grey.

    Tells without colour-science.
    """
    centres = np.atleast_1d(np.asarray(wavelengths_um, dtype=float))
    visible = np.flatnonzero(_visible(centres)).tolist()
    return visible or ([0, 1, 2] if centres.size >= 3 else [0])


def _visible(centres_um: NDArray[np.float64]) -> NDArray[np.bool_]:
    return (centres_um >= VISIBLE_UM[0]) & (centres_um <= VISIBLE_UM[1])


def _true_colour_matrix(centres_um: NDArray[np.float64], fwhm_um: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights (bands, 3) of visible bands in linear sRGB under D65.

    The spectrum is taken as a staircase with one step a band, edges half way between centres. Bands wider
    than their steps (Gaussian responses) see that staircase blurred by a matrix B, whose inverse is
    expanded to second order (van Cittert): 3 - 3 B + B^2. It undoes most of the blur, cannot amplify noise
    by more than 7 and keeps grey exactly grey.
    """
    observer = eye()
    identity = np.eye(centres_um.size)
    distance = observer.wavelength_um[:, np.newaxis] - centres_um
    staircase = identity[np.abs(distance).argmin(axis=1)]
    has_width = fwhm_um > 0
    width = np.where(has_width, np.maximum(fwhm_um, 0.001), 0.001)  # the tables have steps of 1 nm
    response = np.exp(-4.0 * np.log(2.0) * (distance / width) ** 2)
    response /= response.sum(axis=0)
    blur = np.where(has_width[:, np.newaxis], response.T @ staircase, identity)
    spectrum = staircase @ (3.0 * identity - 3.0 * blur + blur @ blur)

    matrix: NDArray[np.float64] = spectrum.T @ observer.to_xyz @ observer.to_rgb
    return matrix / matrix.sum(axis=0)  # white is (1, 1, 1), whatever the digits of the tables


def _false_colour_bands(centres_um: NDArray[np.float64]) -> list[int]:
    """The bands nearest to the middle of each range of FALSE_COLOUR_UM."""
    bands = []
    for name, (low, high) in FALSE_COLOUR_UM.items():
        inside = (centres_um >= low) & (centres_um <= high)
        if not inside.any():
            raise InputError(f"false colour needs a {name} band; the image has none in {low:g} to {high:g} um")
        distance = np.where(inside, np.abs(centres_um - (low + high) / 2), np.inf)
        bands.append(int(distance.argmin()))
    return bands


def used_bands(matrix: Array) -> list[int]:
    """Indices of the bands that a matrix of `rgb_matrix` looks at: no other needs to be read."""
    return [int(band) for band in np.flatnonzero(matrix.any(axis=1))]


def rendering_note(wavelengths_um: ArrayLike, matrix: Array) -> str:
    """One line that says which bands a matrix of `rgb_matrix` shows, and which it does not."""
    centres_nm = np.atleast_1d(np.asarray(wavelengths_um, dtype=float)) * 1000.0
    names = [f"{nm:.0f} nm" if np.isfinite(nm) else f"band {band}" for band, nm in enumerate(centres_nm, 1)]
    used = matrix.any(axis=1)
    groups = {"shown": np.flatnonzero(used), "not shown": np.flatnonzero(~used)}
    lists = {what: _listed([names[band] for band in group]) for what, group in groups.items() if group.size}
    return "; ".join(f"{what}: {listed}" for what, listed in lists.items())


def _listed(names: list[str]) -> str:
    return ", ".join(names) if len(names) <= 6 else f"{len(names)} bands, {names[0]} to {names[-1]}"


def linear_rgb(bands: Iterable[ArrayLike], matrix: Array) -> Array:
    """Linear sRGB (rows, cols, 3) of bands (rows, cols), taken one by one; one row of `matrix` a band.

    Neither clipped nor scaled; nan where a band that counts is nan.
    """
    rgb: Array | None = None
    for band, weights in zip(bands, matrix, strict=True):
        if weights.any():
            part = np.asarray(band, dtype=np.float32)[..., np.newaxis] * weights
            rgb = part if rgb is None else np.add(rgb, part, out=rgb)
    if rgb is None:
        raise InputError("no band of the image counts in the colours asked for")
    return rgb


def srgb(linear: Array, exposure: float = 1.0) -> Array:
    """Linear light times `exposure` as sRGB in [0, 1] (IEC 61966-2-1); nan becomes mid grey."""
    light = np.clip(linear * np.float32(exposure), 0.0, 1.0)
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    encoded[np.isnan(encoded).any(axis=-1)] = NO_DATA_GREY
    return encoded.astype(np.float32, copy=False)


def true_colour(
    reflectance: ArrayLike, wavelengths_um: ArrayLike, fwhm_um: ArrayLike | None = None, exposure: float = 1.0
) -> Array:
    """What an eye would see: sRGB (rows, cols, 3) in [0, 1] of reflectance (bands, rows, cols) under D65."""
    return srgb(linear_rgb(np.asarray(reflectance), rgb_matrix(wavelengths_um, fwhm_um)), exposure)


def exposure_for(linear: Array) -> float:
    """Factor that brings the 98th percentile of luminance to 0.9; 1 where there is no light at all."""
    luminance = linear @ LUMINANCE
    luminance = luminance[np.isfinite(luminance)]
    bright = float(np.percentile(luminance, 98)) if luminance.size else 0.0
    return 0.9 / bright if bright > 0 else 1.0


def flag_classes(flags: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """Index into FLAG_COLOURS of each pixel of `flags.tif`: one reason a pixel, the decisive one."""
    from tscorr.correction import PixelFlag, SpecularState, specular_state

    state = specular_state(flags)
    reasons = {
        "no data": flags & PixelFlag.NODATA != 0,
        "no material": flags & PixelFlag.NO_MATERIAL != 0,
        "corrected": state == SpecularState.CORRECTED,
        "uncorrectable": state == SpecularState.UNCORRECTABLE,
        "in shadow": flags & (PixelFlag.SELF_SHADOW | PixelFlag.CAST_SHADOW) != 0,
        "not viewed, grazing": state == SpecularState.NOT_ASSESSED,
    }
    index = list(FLAG_COLOURS).index
    return np.select(list(reasons.values()), [index(name) for name in reasons], 0).astype(np.uint8)


@cache
def flag_palette() -> NDArray[np.uint8]:
    """Red, green and blue of each value of `flags.tif`: (65536, 3)."""
    return np.array(list(FLAG_COLOURS.values()), np.uint8)[flag_classes(np.arange(1 << 16, dtype=np.uint16))]


def flag_panel(flags: NDArray[np.uint16], before: Array, exposure: float) -> Array:
    """Flags in colours, shaded by the image (rows, cols, 3) in [0, 1]."""
    shade = 0.7 + 0.3 * srgb((before @ LUMINANCE)[..., np.newaxis], exposure)
    palette = np.array(list(FLAG_COLOURS.values()), np.float32) / 255
    return palette[flag_classes(flags)] * shade


def before_after(
    before: Array,
    after: Array,
    flags: NDArray[np.uint16],
    path: Path | str,
    *,
    title: str,
    note: str = "",
    exposure: float | None = None,
) -> None:
    """Write one PNG: before, after and flags at one scale, with a legend.

    `before` and `after` (rows, cols, 3) are linear light from `linear_rgb`, both shown with the same
    `exposure`, by default `exposure_for(before)`. `flags` (rows, cols) has the bits of `PixelFlag`. `note`
    is a line under the pictures, as from `rendering_note`. OutputError: nothing is left of the file.
    """
    if not before.shape == after.shape == (*flags.shape, 3):
        raise InputError(f"shapes differ: before {before.shape}, after {after.shape}, flags {flags.shape}")
    factor = exposure_for(before) if exposure is None else exposure
    panels = {
        "before": _eight_bit(srgb(before, factor)),
        "after": _eight_bit(srgb(after, factor)),
        "flags": _eight_bit(flag_panel(flags, before, factor)),
    }
    caption = f"{note}; exposure × {factor:.3g}".removeprefix("; ")
    _write(_sheet(panels, title, caption), Path(path), "png", "srgb_rec709_scene")


def _sheet(panels: dict[str, NDArray[np.uint8]], title: str, caption: str) -> Any:
    """Panels of one shape on white under their names; side by side, or stacked where they are long strips."""
    from OpenImageIO import ImageBufAlgo

    rows, cols, _ = next(iter(panels.values())).shape
    zoom = -(-400 // max(rows, cols))  # small images are enlarged by whole pixels
    rows, cols = rows * zoom, cols * zoom
    size = min(max(max(rows, cols) // 36, 16), 32)  # of letters; also the gap between things
    cell_width = max(cols, 18 * size)
    across = 1 if cols > 2 * rows else len(panels)
    width = across * (cell_width + size) + size
    top = 3 * size
    cell_height = rows + 3 * size
    bottom = top + cell_height * (len(panels) // across)

    legend = _legend_places(size, width, bottom)
    height = legend[-1][1] + 4 * size
    canvas = np.full((height, width, 3), 255, np.uint8)
    texts = [(size, 2 * size, title, 3 * size // 2), (size, height - size, caption, 4 * size // 5)]
    for index, (name, panel) in enumerate(panels.items()):
        x = size + (index % across) * (cell_width + size)
        y = top + (index // across) * cell_height + 2 * size
        texts.append((x, y - size // 2, name, size))
        canvas[y : y + rows, x : x + cols] = panel.repeat(zoom, axis=0).repeat(zoom, axis=1)
    for (x, y), (name, colour) in zip(legend, FLAG_COLOURS.items(), strict=True):
        canvas[y : y + size, x : x + size] = colour
        texts.append((x + 3 * size // 2, y + 5 * size // 6, name, size))

    image = _image(canvas)
    for x, y, text, letters in texts:
        room = (width - x - size) / max(_text_width(text, letters), 1)
        fitting = max(int(letters * min(room, 1.0)), 1)
        ImageBufAlgo.render_text(image, x, y, text, fitting, _font(), (0.1, 0.1, 0.1))
    return image


def _legend_places(size: int, width: int, top: int) -> list[tuple[int, int]]:
    """Upper left corner (x, y) of each swatch, in lines that fit into the width."""
    places = []
    x, y = size, top
    for name in FLAG_COLOURS:
        needed = 3 * size // 2 + _text_width(name, size)
        if x > size and x + needed + size > width:
            x, y = size, y + 2 * size
        places.append((x, y))
        x += needed + 2 * size
    return places


def _text_width(text: str, size: int) -> int:
    from OpenImageIO import ImageBufAlgo

    return int(ImageBufAlgo.text_size(text, size, _font()).width)


def _font() -> str:
    """The font that comes with matplotlib."""
    import matplotlib as mpl

    return str(Path(mpl.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf")


def write_png(rgb: Array, path: Path | str) -> None:
    """Write sRGB (rows, cols, 3) in [0, 1] as 8-bit PNG; raises OutputError."""
    _write(_image(_eight_bit(rgb)), Path(path), "png", "srgb_rec709_scene")


def write_exr(linear: Array, path: Path | str) -> None:
    """Write linear sRGB (rows, cols, 3) as OpenEXR of 16-bit floats, nan kept; raises OutputError."""
    _write(_image(linear.astype(np.float16)), Path(path), "openexr", "lin_rec709_scene")


def _eight_bit(rgb: Array) -> NDArray[np.uint8]:
    return (rgb * np.float32(255) + np.float32(0.5)).astype(np.uint8)


def _image(pixels: NDArray[np.uint8] | NDArray[np.float16]) -> Any:
    from OpenImageIO import HALF, ROI, UINT8, ImageBuf, ImageSpec

    rows, cols, channels = pixels.shape
    image = ImageBuf(ImageSpec(cols, rows, channels, UINT8 if pixels.dtype == np.uint8 else HALF))
    image.set_pixels(ROI.All, np.ascontiguousarray(pixels))
    return image


FAST_PNG = {"png:compressionLevel": 1, "png:filter": 0x40}
"""each pixel against the mean of two neighbours: a tenth of the default's time for 8 % more bytes"""


def _write(image: Any, path: Path, file_format: str, colour_space: str) -> None:
    """Write under a hidden name, read it back and rename.

    On a full disk OpenImageIO 3.2 cuts a PNG short and reports success; only reading it shows.
    """
    from OpenImageIO import ImageInput, geterror

    image.specmod().set_colorspace(colour_space)
    for key, value in FAST_PNG.items() if file_format == "png" else ():
        image.specmod().attribute(key, value)
    partial = path.with_name(f".partial-{path.name}")
    try:
        if not image.write(str(partial), fileformat=file_format):
            raise OutputError(f"{path}: {image.geterror() or geterror()}")
        written = ImageInput.open(str(partial))
        if written is None or written.read_image("uint8" if file_format == "png" else "half") is None:
            raise OutputError(f"{path}: written, but cannot be read again: {geterror()}")
        written.close()
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
