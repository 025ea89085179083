"""STAC items of scenes and the collection of a batch, as plain dicts: core 1.1.0.

The versions of the extensions are those that pystac reads. Hrefs are relative to the file that a dict is written
to, `<scene>/item.json` and `collection.json` above it, so that a folder of results can be moved as a whole.
"""

import datetime as dt
import math
import os
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np

from tscorr.correction import PixelFlag, SpecularState
from tscorr.grid import Grid, longitude_latitude

if TYPE_CHECKING:
    from tscorr.rasters import RasterInfo

Json = dict[str, Any]
Bands = tuple[tuple[str, ...], tuple[float, ...] | None, tuple[float, ...] | None]
"""names, wavelengths [um] and widths [um] of the image's bands; nan or None where unknown"""

EXTENSIONS = {  # by the prefix of their fields
    "eo": "https://stac-extensions.github.io/eo/v1.1.0/schema.json",
    "raster": "https://stac-extensions.github.io/raster/v1.1.0/schema.json",
    "view": "https://stac-extensions.github.io/view/v1.0.0/schema.json",
    "classification": "https://stac-extensions.github.io/classification/v2.0.0/schema.json",
    "processing": "https://stac-extensions.github.io/processing/v1.1.0/schema.json",
    "proj": "https://stac-extensions.github.io/projection/v2.0.0/schema.json",
}
LINEAGE = "Specular peak of man-made surfaces removed with the Torrance-Sparrow model of Meister et al. 2000"
RASTERS = {
    "corrected": ("image without the specular peak", "data reflectance"),
    "flags": ("what was done to each pixel", "metadata data-mask saturation terrain-shadow terrain-occlusion"),
    "removed": ("input minus corrected", "data"),
    "uncertainty": ("one sigma of the corrected values", "metadata"),
    "azimuthal_width": ("width of the specular peak in azimuth", "metadata"),
    "angles": ("directions of sun and sensor", "metadata incidence-angle azimuth sun-azimuth"),
}
"""title and roles"""
TIFF_TIME = "TIFFTAG_DATETIME"
TIFF = "image/tiff; application=geotiff"
MEDIA = {".tif": TIFF, ".vrt": "application/xml", ".dat": "application/octet-stream", ".hdr": "text/plain"}
"""by the end of a raster's name; .dat and .hdr are an ENVI file and its header"""
DOCUMENTS = {
    "quicklook": ("quicklook.png", "image/png", "before, after and flags", "overview"),
    "report_json": ("report.json", "application/json", "report, for programs", "metadata"),
    "report_html": ("report.html", "text/html", "report, for readers", "metadata"),
    "settings": ("settings.toml", "application/toml", "settings used", "metadata"),
    "manifest": ("manifest.json", "application/json", "hashes of inputs and outputs", "metadata"),
}
"""file, media type, title and roles"""
FLAG_TEXTS = {
    PixelFlag.NODATA: "the input has no data here",
    PixelFlag.NO_MATERIAL: "the class has no material",
    PixelFlag.SELF_SHADOW: "the sun is behind the facet",
    PixelFlag.CAST_SHADOW: "another surface hides the sun",
    PixelFlag.NOT_VIEWED: "the sensor is behind the facet or hidden from it",
    PixelFlag.GRAZING: "incidence or exitance beyond what is allowed",
    PixelFlag.SPECULAR_STATE: "what became of the specular peak",
    PixelFlag.SATURATED: "a band of the input is saturated",
    PixelFlag.CLIPPED: "the result left the range of the data type or fell below zero",
    PixelFlag.UNCERTAIN: "sigma of what was removed exceeds half the corrected value",
    PixelFlag.NORMAL_UNRELIABLE: "void or step edge of the surface model under the window",
    PixelFlag.LOW_CONFIDENCE: "class confidence under 0.5",
}
STATES = [state.name.lower() for state in SpecularState]


def item(
    *,
    name: str,
    grid: Grid,
    datetime: dt.datetime | None,
    files: Mapping[str, "RasterInfo"],
    inputs: Sequence[Path],
    solar_zenith_deg: float,
    solar_azimuth_deg: float,
    view_zenith_deg: float,
    view_azimuth_deg: float,
    bands: Bands,
    report: Mapping[str, Any],
    version: str,
    quicklook: bool = True,
    strips: Sequence[str] = (),
    cloud_optimised: bool = False,
) -> Json:
    """The STAC item of one scene's folder.

    datetime  : when the image was taken; where None, its TIFF tag or the time of its last change serves.
    files     : rasters written, by product, in the item's folder.
    inputs    : every file read, the image first.
    view_*    : for the whole scene, of surface -> sensor from the vertical and true north; nan if unknown.
    report    : content of report.json.
    quicklook : whether quicklook.png was drawn.
    cloud_optimised : whether the GeoTIFFs are.
    strips    : names of the files that hold the pixels of `files`, where those are VRTs.

    A scene across the 180th meridian is not cut there. OSError where the image has no time and is gone.
    """
    time, time_source = _time(datetime, files, inputs[0])
    properties = {
        "datetime": time,
        "tscorr:datetime_source": time_source,
        "processing:software": {"tscorr": version},
        "processing:lineage": LINEAGE,
        **_projection(grid),
        **_view(solar_zenith_deg, solar_azimuth_deg, view_zenith_deg, view_azimuth_deg),
    }
    assets = {key: _raster(key, info, bands, report) for key, info in files.items()}
    for key, info in files.items():
        if cloud_optimised and info.path.suffix == ".tif":
            assets[key]["type"] = f"{TIFF}; profile=cloud-optimized"
        if info.path.suffix == ".dat":
            header = info.path.with_suffix(".hdr").name
            assets[f"{key}_header"] = _asset(header, MEDIA[".hdr"], f"header of {info.path.name}", "metadata")
    assets |= {Path(name).stem: _asset(name, TIFF, f"strip of {name.split('.')[0]}", "data") for name in strips}
    assets |= {key: _asset(*entry) for key, entry in DOCUMENTS.items() if quicklook or key != "quicklook"}
    folder = next((info.path.parent for info in files.values()), None)
    prefixes = {key.partition(":")[0] for fields in (properties, *assets.values()) for key in fields}
    return {
        "type": "Feature",
        "stac_version": "1.1.0",
        "stac_extensions": [uri for prefix, uri in EXTENSIONS.items() if prefix in prefixes],
        "id": name,
        **_footprint(grid),
        "properties": properties,
        "links": [{"rel": "derived_from", "href": _href(path, folder), "title": path.name} for path in inputs],
        "assets": assets,
    }


def collection(*, title: str, items: Sequence[Mapping[str, Any]]) -> Json:
    """The STAC collection of a batch; items lie in folders named by their ids.

    The extent is the whole world where no item has a place, and all time where there is no item.
    """
    boxes = [entry["bbox"] for entry in items if "bbox" in entry] or [[-180.0, -90.0, 180.0, 90.0]]
    west, south, east, north = zip(*boxes, strict=True)
    times = [entry["properties"]["datetime"] for entry in items]  # of one format: text sorts as time
    return {
        "type": "Collection",
        "stac_version": "1.1.0",
        "id": re.sub(r"[\W_]+", "-", title.lower()).strip("-") or "tscorr",
        "title": title or "tscorr",
        "description": "Airborne images from which tscorr removed the specular peak of man-made surfaces.",
        "license": "other",
        "extent": {
            "spatial": {"bbox": [[min(west), min(south), max(east), max(north)]]},
            "temporal": {"interval": [[min(times, default=None), max(times, default=None)]]},
        },
        "links": [
            {"rel": "item", "href": f"./{quote(entry['id'])}/item.json", "type": "application/geo+json"}
            for entry in items
        ],
    }


def _time(time: dt.datetime | None, files: Mapping[str, "RasterInfo"], image: Path) -> tuple[str, str]:
    """Time of an image as STAC writes it, and where it is from; products have the tags of the image."""
    source = "time given for the sun"
    tag = next((info.tags[TIFF_TIME] for info in files.values() if TIFF_TIME in info.tags), None)
    if time is None and tag is not None:
        with suppress(ValueError):  # many programs write what they like
            time = dt.datetime.strptime(tag, "%Y:%m:%d %H:%M:%S").replace(tzinfo=dt.UTC)
            source = f"{TIFF_TIME} of the image, taken as UTC"
    if time is None:
        time = dt.datetime.fromtimestamp(image.stat().st_mtime, dt.UTC)
        source = "last change of the image file; the time of acquisition is unknown"
    return time.astimezone(dt.UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z"), source


def _footprint(grid: Grid) -> Json:
    """Geometry and bbox on WGS 84, to 1 cm; geometry null and no bbox where the grid has no CRS."""
    if grid.crs is None:
        return {"geometry": None}
    xs, ys = np.round(longitude_latitude(grid, *grid.corners()), 7).tolist()
    ring = [list(point) for point in zip([*xs, xs[0]], [*ys, ys[0]], strict=True)]
    doubled_area = sum(x0 * y1 - x1 * y0 for (x0, y0), (x1, y1) in pairwise(ring))
    ring = ring if doubled_area > 0 else ring[::-1]  # counterclockwise: RFC 7946, section 3.1.6
    return {"geometry": {"type": "Polygon", "coordinates": [ring]}, "bbox": [min(xs), min(ys), max(xs), max(ys)]}


def _projection(grid: Grid) -> Json:
    """Fields of the projection extension: only the shape where the grid has no CRS."""
    shape = {"proj:code": None, "proj:shape": list(grid.shape)}
    if grid.crs is None:
        return shape
    xs, ys = grid.corners()
    box = [float(limit) for limit in (xs.min(), ys.min(), xs.max(), ys.max())]
    code, wkt = grid.crs.to_authority(), grid.crs.to_wkt(version="WKT2_2019")
    named = {"proj:code": ":".join(code)} if code else {"proj:wkt2": wkt}
    return {**shape, **named, "proj:bbox": box, "proj:transform": list(grid.transform[:6])}


def _view(solar_zenith: float, solar_azimuth: float, view_zenith: float, view_azimuth: float) -> Json:
    """Fields of the view extension, from angles [deg]; its view azimuth is that of sensor -> surface.

    Under an aircraft the earth is flat: the angle off nadir is the one from the vertical at the surface.
    """
    fields = {
        "view:sun_elevation": 90 - solar_zenith,
        "view:sun_azimuth": solar_azimuth % 360,
        "view:incidence_angle": view_zenith,
        "view:off_nadir": view_zenith,
        "view:azimuth": (view_azimuth + 180) % 360,
    }
    return {key: round(float(value), 4) for key, value in fields.items() if math.isfinite(value)}


def _href(path: Path, folder: Path | None) -> str:
    """The way from a folder to a file; a file URI where there is none."""
    if folder is not None:
        with suppress(ValueError):  # on another drive
            return quote(Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix())
    return path.resolve().as_uri()


def _asset(file: str, media: str, title: str, roles: str) -> Json:
    return {"href": f"./{quote(file)}", "type": media, "title": title, "roles": roles.split()}


def _raster(key: str, info: "RasterInfo", bands: Bands, report: Mapping[str, Any]) -> Json:
    """The asset of a raster: names in the bands of the core, numbers in those of the extensions."""
    nodata = "nan" if info.nodata is not None and math.isnan(info.nodata) else info.nodata
    unit = "degree" if key in {"azimuthal_width", "angles"} else None
    common = {"data_type": info.dtype.name, "nodata": nodata, "unit": unit}
    scaling = zip(info.scales, info.offsets, strict=True)
    asset = _asset(info.path.name, MEDIA[info.path.suffix], *RASTERS[key])
    asset["bands"] = [{"name": name} for name in info.names]
    asset["raster:bands"] = [_known(**common, scale=scale, offset=offset) for scale, offset in scaling]
    if key in {"corrected", "removed", "uncertainty"}:
        unknown = (None,) * len(bands[0])
        columns = zip(bands[0], bands[1] or unknown, bands[2] or unknown, strict=True)
        asset["eo:bands"] = [_known(name=name, center_wavelength=um, full_width_half_max=w) for name, um, w in columns]
    if key == "flags":
        counts = {**report["pixels"], **({} if report["uncertainty_evaluated"] else {"uncertain": None})}
        asset["classification:bitfields"] = [_bitfield(flag, counts) for flag in FLAG_TEXTS]
    return asset


def _known(**fields: Any) -> Json:
    """Fields without those that are None or nan."""
    return {key: value for key, value in fields.items() if value is not None and value == value}  # noqa: PLR0124 - nan


def _bitfield(flag: PixelFlag, counts: Mapping[str, int | None]) -> Json:
    """A flag of flags.tif, with the number of pixels where they were counted."""
    name = str(flag.name).lower()
    labels = STATES if flag is PixelFlag.SPECULAR_STATE else ["no", "yes"]
    counts = {**counts, "no": None, "yes": counts.get(name)}
    return {
        "offset": (flag & -flag).bit_length() - 1,
        "length": flag.bit_count(),
        "name": name,
        "description": FLAG_TEXTS[flag],
        "classes": [_known(value=value, name=label, count=counts[label]) for value, label in enumerate(labels)],
    }
