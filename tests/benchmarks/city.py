"""A made city of any size: image, class map, surface model with gabled roofs, and a configuration.

Buildings stand on a lattice of streets, each of one material with one brightness; half of them and the ground have
no peak. Sun and camera stand so that the materials with a peak, 10 to 20 % of the pixels, are in their lobe.
Every pixel depends on its place and the seed alone. Written in rows of tiles, so memory does not grow with size.
"""

from pathlib import Path

import numpy as np
import rasterio
import tomli_w
from affine import Affine

CELL_M = 0.5
WEST, NORTH = 80000.0, 450000.0
PITCH_PX = 64
"""from one building to the next"""
MATERIALS = {1: "roof_tile", 2: "red_concrete", 3: "blue_concrete", 4: "red_aluminum", 5: "lambertian"}
SHARES = (0.36, 0.14, 0.08, 0.1, 0.32)
"""of the buildings"""
GROUND = 5
BRIGHTNESS = {1: 0.16, 2: 0.22, 3: 0.18, 4: 0.2, 5: 0.12}
NOISE = 0.006
"""of the image, in reflectance: DEFLATE then halves it, roughly"""
HEIGHT_NOISE_M = 0.03
SCALE = 1e-4
SEED = 2000


class Lattice:
    """The buildings: arrays over cells of PITCH_PX, each with at most one building."""

    def __init__(self, rows, cols):
        rng = np.random.default_rng(SEED)
        shape = -(-rows // PITCH_PX), -(-cols // PITCH_PX)
        self.material = rng.choice(list(MATERIALS), shape, p=SHARES)
        self.height, self.width = rng.integers(22, 46, (2, *shape))
        self.slope = rng.choice(np.tan(np.deg2rad([5.0, 15.0, 25.0, 35.0])), shape)
        self.eave_m = rng.uniform(3, 12, shape)
        self.brightness = rng.uniform(0.8, 1.2, shape)

    def strip(self, row, height, cols):
        """Classes uint8, heights float32 [m] and brightness of `height` rows from `row` on."""
        down, right = np.arange(row, row + height), np.arange(cols)
        i, j = down[:, None] // PITCH_PX, right[None] // PITCH_PX
        y, x = down[:, None] % PITCH_PX - PITCH_PX / 2 + 0.5, right[None] % PITCH_PX - PITCH_PX / 2 + 0.5
        inside = (np.abs(y) < self.height[i, j] / 2) & (np.abs(x) < self.width[i, j] / 2)
        classes = np.where(inside, self.material[i, j], GROUND).astype(np.uint8)
        ridge_m = self.eave_m[i, j] + (self.height[i, j] / 2 - np.abs(y)) * CELL_M * self.slope[i, j]
        brightness = np.where(inside, self.brightness[i, j], 1.0)
        return classes, np.where(inside, ridge_m, 0.0).astype(np.float32), brightness.astype(np.float32)


def profile_of(codec, interleave, tile):
    """Creation options; predictors as the data are used to."""
    profile = {"driver": "GTiff", "tiled": True, "blockxsize": tile, "blockysize": tile, "interleave": interleave}
    if codec != "none":
        profile |= {"compress": codec, "predictor": 2, "num_threads": 2}
        profile |= {"zlevel": 6} if codec == "deflate" else {"zstd_level": 1} if codec == "zstd" else {}
    return profile | {"crs": "EPSG:28992", "transform": Affine(CELL_M, 0, WEST, 0, -CELL_M, NORTH)}


def make_city(folder, rows, cols, *, bands=4, codec="none", interleave="pixel", tile=512):
    """The inputs of a scene in a folder; the path of the image."""
    folder.mkdir(parents=True, exist_ok=True)
    lattice = Lattice(rows, cols)
    shared = {**profile_of(codec, interleave, tile), "height": rows, "width": cols, "bigtiff": "if_safer"}
    dsm = {**shared, **({"predictor": 3} if codec != "none" else {})}
    colours = np.random.default_rng(SEED).uniform(0.7, 1.4, bands).astype(np.float32)
    level = np.array([BRIGHTNESS.get(value, 0) for value in range(256)], np.float32)
    path = folder / "image.tif"
    with (
        rasterio.open(path, "w", **shared, count=bands, dtype="uint16") as image,
        rasterio.open(folder / "class_map.tif", "w", **shared, count=1, dtype="uint8") as class_map,
        rasterio.open(folder / "dsm.tif", "w", **dsm, count=1, dtype="float32") as surface,
    ):
        image.scales = (SCALE,) * bands
        for row in range(0, rows, tile):
            height = min(tile, rows - row)
            rng = np.random.default_rng([SEED, row])
            window = rasterio.windows.Window(0, row, cols, height)
            classes, heights, brightness = lattice.strip(row, height, cols)
            heights += HEIGHT_NOISE_M * rng.standard_normal(heights.shape, np.float32)
            class_map.write(classes, 1, window=window)
            surface.write(np.round(heights, 3), 1, window=window)
            diffuse = level[classes] * brightness
            at_once = bands if interleave == "pixel" else 4
            for first in range(0, bands, at_once):
                some = colours[first : first + at_once, None, None]
                values = diffuse * some + NOISE * rng.standard_normal((len(some), *diffuse.shape), np.float32)
                stored = np.clip(values / SCALE + 0.5, 1, 65535).astype(np.uint16)
                image.write(stored, list(range(first + 1, first + 1 + len(some))), window=window)
    return path


def make_sparse_classes(image, share):
    """The class map of a city that has materials with a peak in a share of the tiles only, beside it; its name."""
    target = image.with_name("sparse_class_map.tif")
    with rasterio.open(image.with_name("class_map.tif")) as whole, rasterio.open(target, "w", **whole.profile) as few:
        windows = [window for _, window in whole.block_windows(1)]
        kept = np.random.default_rng(SEED).permutation(len(windows)) < round(share * len(windows))
        for window, keep in zip(windows, kept, strict=True):
            classes = whole.read(1, window=window)
            few.write(classes if keep else np.full_like(classes, GROUND), 1, window=window)
    return target.name


def write_config(
    image,
    *,
    name="city",
    flat=False,
    shadows=False,
    products=("corrected", "flags"),
    quicklook=False,
    form="gtiff",
    corrected="file",
    class_map="class_map.tif",
    **run,
):
    """A configuration of the city beside its image; its path.

    name : of the configuration. form : of the files. corrected : a file, or a VRT. run : keys of [run].
    """
    with rasterio.open(image) as file:
        (rows, cols), bands = file.shape, file.count
    side_m = CELL_M * max(rows, cols)
    middle = WEST + cols * CELL_M / 2, NORTH - rows * CELL_M / 2
    scene = {
        "name": "city",
        "image": str(image),
        "class_map": str(image.with_name(class_map)),
        "sun": {"zenith_deg": 40.0, "azimuth_deg": 180.0},
        "view": {"kind": "frame", "position": [middle[0], middle[1] + 0.3 * side_m, 0.6 * side_m + 100]},
        "surface": {"kind": "flat"} if flat else {"kind": "dsm", "path": str(image.with_name("dsm.tif"))},
        "shadows": shadows,
    }
    if quicklook:
        scene["wavelength_um"] = np.linspace(0.45, 0.85, bands).tolist()  # in true colour
    values = {
        "output": {
            "directory": str(image.with_name("out")),
            "products": list(products),
            "quicklook": quicklook,
            "format": form,
            "corrected": corrected,
        },
        "run": run,
        "materials": {"classes": {str(value): name for value, name in MATERIALS.items()}},
        "scenes": [scene],
    }
    path = Path(image).with_name(f"{name}.toml")
    path.write_text(tomli_w.dumps(values), encoding="utf-8")
    return path
