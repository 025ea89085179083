"""Pictures of pixels for a page: the preview made smaller, and the map of widths.

Pillow, which comes with matplotlib, is imported here and only to draw.
"""

import io
from pathlib import Path

import numpy as np

from tscorr.report.facts import Array

LARGEST_PNG = 300_000
WIDEST_PICTURE = 1800
RAMP = ((0, 34, 78), (65, 77, 107), (124, 123, 120), (188, 175, 111), (254, 232, 56))
"""anchors of cividis (Nuñez, Anderton, Renslow 2018): even in lightness, for any colour vision"""
STEPS = 64
"""colours of the map"""


def embeddable(picture: Path) -> tuple[bytes, str]:
    """A PNG small enough for a page, and its media type: as it is, or as a JPEG of at most 1800 pixels."""
    data = picture.read_bytes()
    if len(data) <= LARGEST_PNG:
        return data, "image/png"
    from PIL import Image

    buffer = io.BytesIO()
    with Image.open(io.BytesIO(data)) as whole:
        smaller = whole.convert("RGB")
        smaller.thumbnail((WIDEST_PICTURE, 4 * WIDEST_PICTURE))
        smaller.save(buffer, "JPEG", quality=85, optimize=True)
    return buffer.getvalue(), "image/jpeg"


def width_map(width_deg: Array) -> tuple[bytes, float]:
    """A PNG of widths (rows, cols): narrow dark, wide bright, nan transparent; and the brightest's width.

    Bright is the 98th percentile [deg] and all above, so that a few pixels do not decide the colours.
    """
    from PIL import Image

    finite = width_deg[np.isfinite(width_deg)]
    top = float(np.percentile(finite, 98)) if finite.size else 1.0
    level = np.where(np.isnan(width_deg), 0, 1 + np.clip(width_deg / top, 0, 1) * (STEPS - 1))
    place, anchors = np.linspace(0, 1, STEPS), np.linspace(0, 1, len(RAMP))
    colours = np.stack([np.interp(place, anchors, channel) for channel in np.transpose(RAMP)], axis=1)
    buffer = io.BytesIO()
    image = Image.fromarray(level.round().astype(np.uint8), mode="P")
    image.putpalette([255, 255, 255, *colours.round().astype(int).ravel().tolist()])
    image.save(buffer, "PNG", transparency=0, optimize=True)
    return buffer.getvalue(), top
