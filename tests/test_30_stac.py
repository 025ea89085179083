"""Items and collections against the core's schemas as pystac ships them, and what pystac reads back from them."""

import json
import os
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import pystac
import pytest
from affine import Affine
from jsonschema import Draft7Validator
from pystac.extensions.classification import ClassificationExtension
from pystac.extensions.eo import EOExtension
from pystac.extensions.projection import ProjectionExtension
from pystac.extensions.raster import RasterExtension
from pystac.extensions.view import ViewExtension
from pystac.validation.stac_validator import JsonSchemaSTACValidator
from rasterio.crs import CRS
from rasterio.features import bounds as geometry_bounds
from rasterio.warp import transform_bounds, transform_geom

from tscorr import stac
from tscorr.correction import PixelFlag, SpecularState
from tscorr.grid import Grid
from tscorr.rasters import RasterInfo

DELFT = Grid(CRS.from_epsg(28992), Affine(0.5, 0, 84664, 0, -0.5, 447719), (576, 848))
NOON = datetime(2026, 6, 21, 12, 12, tzinfo=timezone(timedelta(hours=2)))
NAMES, WAVELENGTHS_UM, FWHM_UM = ("blue", "red", "nir"), (0.475, 0.668, 0.84), (0.02, 0.01, 0.04)
ANGLES = ("incidence", "exitance", "relative_azimuth", "facet_tilt")
COUNTS = {str(flag).lower(): 100 + i for i, flag in enumerate(PixelFlag.__members__) if flag != "SPECULAR_STATE"}
STATES = {"negligible": 1, "corrected": 2, "uncorrectable": 3, "not_assessed": 4}
REPORT = {"pixels": {"total": 1000, "valid": 900, "evaluated": 800, **STATES, **COUNTS}, "uncertainty_evaluated": True}
FIELDS = {  # every field that the extensions define, and what it may hold; see https://stac-extensions.github.io
    "eo": {
        "eo:bands": {
            "type": "array",
            "minItems": 1,
            "items": {
                "properties": {
                    "name": {"type": "string"},
                    "center_wavelength": {"type": "number"},
                    "full_width_half_max": {"type": "number"},
                },
                "additionalProperties": False,
            },
        }
    },
    "raster": {
        "raster:bands": {
            "type": "array",
            "minItems": 1,
            "items": {
                "properties": {
                    "data_type": {"enum": ["uint8", "int16", "uint16", "float32"]},
                    "nodata": {"anyOf": [{"type": "number"}, {"enum": ["nan", "inf", "-inf"]}]},
                    "scale": {"type": "number"},
                    "offset": {"type": "number"},
                    "unit": {"type": "string"},
                },
                "additionalProperties": False,
            },
        }
    },
    "view": {
        "view:off_nadir": {"type": "number", "minimum": 0, "maximum": 90},
        "view:incidence_angle": {"type": "number", "minimum": 0, "maximum": 90},
        "view:azimuth": {"type": "number", "minimum": 0, "maximum": 360},
        "view:sun_azimuth": {"type": "number", "minimum": 0, "maximum": 360},
        "view:sun_elevation": {"type": "number", "minimum": -90, "maximum": 90},
    },
    "classification": {
        "classification:bitfields": {
            "type": "array",
            "minItems": 1,
            "uniqueItems": True,
            "items": {
                "required": ["offset", "length", "classes"],
                "properties": {
                    "offset": {"type": "integer", "minimum": 0},
                    "length": {"type": "integer", "minimum": 1},
                    "name": {"type": "string", "pattern": "^[0-9A-Za-z_-]+$"},
                    "description": {"type": "string"},
                    "classes": {
                        "type": "array",
                        "minItems": 1,
                        "uniqueItems": True,
                        "items": {
                            "required": ["value", "name"],
                            "properties": {
                                "value": {"type": "integer"},
                                "name": {"type": "string", "pattern": "^[0-9A-Za-z_-]+$"},
                                "count": {"type": "integer", "minimum": 0},
                            },
                            "additionalProperties": False,
                        },
                    },
                },
                "additionalProperties": False,
            },
        }
    },
    "processing": {
        "processing:software": {"type": "object", "additionalProperties": {"type": "string"}},
        "processing:lineage": {"type": "string"},
    },
    "proj": {
        "proj:code": {"type": ["string", "null"]},
        "proj:wkt2": {"type": ["string", "null"]},
        "proj:bbox": {"type": "array", "minItems": 4, "maxItems": 4, "items": {"type": "number"}},
        "proj:shape": {"type": "array", "minItems": 2, "maxItems": 2, "items": {"type": "integer"}},
        "proj:transform": {"type": "array", "minItems": 6, "maxItems": 6, "items": {"type": "number"}},
    },
}


def raster(path, grid, names, dtype, nodata=None, scale=1.0, offset=0.0, tags=None):
    count = len(names)
    return RasterInfo(
        path=path,
        grid=grid,
        bands=count,
        dtype=np.dtype(dtype),
        nodata=nodata,
        scales=(scale,) * count,
        offsets=(offset,) * count,
        names=names,
        wavelengths_um=None,
        fwhm_um=None,
        tile=(256, 256),
        profile={},
        tags=tags or {},
        band_tags=({},) * count,
    )


@pytest.fixture
def scene(tmp_path):
    """Arguments of `stac.item` for a scene in out/forward, of two inputs in a folder beside out."""
    folder = tmp_path / "out" / "forward"
    folder.mkdir(parents=True)
    inputs = [tmp_path / "in" / "an image.tif", tmp_path / "in" / "dsm.tif"]
    inputs[0].parent.mkdir()
    for path in inputs:
        path.touch()
    image = {"names": NAMES, "dtype": "int16", "scale": 1e-4, "offset": 0.25}
    nan = {"dtype": "float32", "nodata": float("nan")}
    return {
        "name": "forward",
        "grid": DELFT,
        "datetime": NOON,
        "files": {
            "corrected": raster(folder / "corrected.tif", DELFT, **image, nodata=-9999.0),
            "flags": raster(folder / "flags.tif", DELFT, ("flags",), "uint16"),
            "removed": raster(folder / "removed.tif", DELFT, **image),
            "azimuthal_width": raster(folder / "azimuthal_width.tif", DELFT, ("azimuthal width",), **nan),
            "angles": raster(folder / "angles.tif", DELFT, ANGLES, **nan),
        },
        "inputs": inputs,
        "solar_zenith_deg": 40.0,
        "solar_azimuth_deg": 170.0,
        "view_zenith_deg": 35.5,
        "view_azimuth_deg": 350.0,
        "bands": (NAMES, WAVELENGTHS_UM, FWHM_UM),
        "report": REPORT,
        "version": "0.1.0",
    }


@pytest.fixture(scope="module")
def validator():
    """pystac's validator, with schemas of the extensions in its cache, so that nothing is fetched."""
    offline = JsonSchemaSTACValidator()
    for prefix, fields in FIELDS.items():
        uri = stac.EXTENSIONS[prefix]
        holder = {
            "properties": fields,
            "patternProperties": {f"^(?!{prefix}:)": {}},
            "additionalProperties": False,
        }
        offline.schema_cache[uri] = {
            "$schema": "http://json-schema.org/draft-07/schema#",
            "$id": uri,
            "properties": {"properties": holder, "assets": {"additionalProperties": holder}},
        }
    return offline


def validated(thing, validator):
    """What pystac makes of a dict that went through JSON and is valid."""
    text = json.dumps(thing, allow_nan=False)
    kind = pystac.Item if thing["type"] == "Feature" else pystac.Collection
    parsed = kind.from_dict(json.loads(text), migrate=False)
    checked = validator.validate(thing, kind.STAC_OBJECT_TYPE, thing["stac_version"], thing.get("stac_extensions", []))
    assert len(checked) == 1 + len(thing.get("stac_extensions", []))
    return parsed


def test_item_is_valid_and_declares_exactly_the_extensions_it_uses(scene, validator):
    item = validated(stac.item(**scene), validator)
    assert item.id == "forward"
    assert item.stac_extensions == list(stac.EXTENSIONS.values())
    for schema in validator.schema_cache.values():
        Draft7Validator.check_schema(schema)
    bare = validated(stac.item(**{**scene, "files": {}}), validator)
    declared = {stac.EXTENSIONS[prefix] for prefix in ("view", "processing", "proj")}
    assert set(bare.stac_extensions) == declared


def test_extensions_are_those_that_pystac_reads():
    known = {
        "eo": EOExtension,
        "raster": RasterExtension,
        "view": ViewExtension,
        "classification": ClassificationExtension,
        "proj": ProjectionExtension,
    }
    for prefix, extension in known.items():
        assert stac.EXTENSIONS[prefix] == extension.get_schema_uri()


def test_footprint_is_that_of_the_corners(scene, validator):
    item = validated(stac.item(**scene), validator)
    west, south, east, north = 84664, 447719 - 288, 84664 + 424, 447719
    square = {
        "type": "Polygon",
        "coordinates": [[[west, south], [east, south], [east, north], [west, north], [west, south]]],
    }
    expected = transform_geom(DELFT.crs, "EPSG:4326", square)
    ring, wanted = item.geometry["coordinates"][0], expected["coordinates"][0]
    assert ring[0] == ring[-1]
    assert len(ring) == 5
    np.testing.assert_allclose(sorted(ring[:4]), sorted(wanted[:4]), rtol=0, atol=1e-7)
    assert signed_area(ring) > 0
    np.testing.assert_allclose(item.bbox, geometry_bounds(expected), rtol=0, atol=1e-7)
    around = transform_bounds(DELFT.crs, "EPSG:4326", west, south, east, north)
    np.testing.assert_allclose(item.bbox, around, rtol=0, atol=1e-6)


def signed_area(ring):
    x, y = np.array(ring).T
    return 0.5 * float(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]))


@pytest.mark.parametrize("transform", [Affine(1, 0, 5e5, 0, 1, 5e6), Affine(0, 1, 5e5, 1, 0, 5e6)])
def test_ring_is_counterclockwise_however_the_grid_is_turned(scene, transform):
    grid = Grid(CRS.from_epsg(32631), transform, (30, 40))
    item = stac.item(**{**scene, "grid": grid})
    assert signed_area(item["geometry"]["coordinates"][0]) > 0


def test_projection_reads_back(scene, validator):
    item = validated(stac.item(**scene), validator)
    projection = ProjectionExtension.ext(item)
    assert projection.epsg == 28992
    assert projection.shape == [576, 848]
    assert projection.transform == [0.5, 0, 84664, 0, -0.5, 447719]
    assert projection.bbox == [84664, 447431, 85088, 447719]
    assert projection.wkt2 is None


def test_crs_without_a_code_is_written_out(scene, validator):
    crs = CRS.from_proj4("+proj=lcc +lat_1=50 +lat_2=54 +lat_0=52 +lon_0=4 +datum=WGS84 +units=m")
    item = validated(stac.item(**{**scene, "grid": replace(DELFT, crs=crs)}), validator)
    projection = ProjectionExtension.ext(item)
    assert projection.code is None
    assert CRS.from_wkt(projection.wkt2) == crs


def test_grid_without_crs_has_no_place(scene, validator):
    thing = stac.item(**{**scene, "grid": replace(DELFT, crs=None)})
    item = validated(thing, validator)
    assert item.geometry is None
    assert "bbox" not in thing
    assert ProjectionExtension.ext(item).code is None
    assert ProjectionExtension.ext(item).shape == [576, 848]


def test_view_reads_back(scene, validator):
    view = ViewExtension.ext(validated(stac.item(**scene), validator))
    assert view.sun_elevation == 50
    assert view.sun_azimuth == 170
    assert view.incidence_angle == view.off_nadir == 35.5
    assert view.azimuth == 170  # the sensor stands in the north, at 350: it looks south


def test_unknown_view_is_left_out(scene, validator):
    nan = float("nan")
    item = validated(stac.item(**{**scene, "view_zenith_deg": nan, "view_azimuth_deg": nan}), validator)
    assert {key for key in item.properties if key.startswith("view:")} == {"view:sun_elevation", "view:sun_azimuth"}


@pytest.mark.parametrize("key", ["corrected", "removed"])
def test_image_bands_read_back(scene, validator, key):
    asset = validated(stac.item(**scene), validator).assets[key]
    bands = EOExtension.ext(asset).bands
    assert [(band.name, band.center_wavelength, band.full_width_half_max) for band in bands] == list(
        zip(NAMES, WAVELENGTHS_UM, FWHM_UM, strict=True)
    )
    for band in RasterExtension.ext(asset).bands:
        assert (band.data_type, band.scale, band.offset) == ("int16", 1e-4, 0.25)
        assert band.nodata == (-9999 if key == "corrected" else None)


@pytest.mark.parametrize("bands", [(NAMES, None, None), (NAMES, (0.475, float("nan"), 0.84), None)])
def test_unknown_wavelengths_are_left_out(scene, validator, bands):
    item = validated(stac.item(**{**scene, "bands": bands}), validator)
    written = EOExtension.ext(item.assets["corrected"]).bands
    assert [band.name for band in written] == list(NAMES)
    assert written[1].center_wavelength is None
    assert [band.full_width_half_max for band in written] == [None] * 3


def test_layers_of_angles_are_named_and_in_degrees(scene, validator):
    asset = validated(stac.item(**scene), validator).assets["angles"]
    assert [band["name"] for band in asset.extra_fields["bands"]] == list(ANGLES)
    assert [(band.unit, band.nodata) for band in RasterExtension.ext(asset).bands] == [("degree", "nan")] * 4
    assert "eo:bands" not in asset.extra_fields


def test_bits_of_the_flags_read_back_as_the_enum(scene, validator):
    asset = validated(stac.item(**scene), validator).assets["flags"]
    fields = ClassificationExtension.ext(asset).bitfields
    masks = {field.name: ((1 << field.length) - 1) << field.offset for field in fields}
    assert masks == {name.lower(): int(flag) for name, flag in PixelFlag.__members__.items()}
    named = {field.name: field for field in fields}
    for name, count in COUNTS.items():
        no, yes = named[name].classes
        assert (no.value, no.name, no.count) == (0, "no", None)
        assert (yes.value, yes.name, yes.count) == (1, "yes", count)
    states = named["specular_state"].classes
    assert [(state.value, state.name, state.count) for state in states] == [
        (int(state), state.name.lower(), STATES[state.name.lower()]) for state in SpecularState
    ]


def test_uncertain_pixels_have_no_count_where_nobody_looked(scene):
    report = {**REPORT, "uncertainty_evaluated": False}
    item = stac.item(**{**scene, "report": report})
    fields = {field["name"]: field for field in item["assets"]["flags"]["classification:bitfields"]}
    assert "count" not in fields["uncertain"]["classes"][1]
    assert fields["clipped"]["classes"][1]["count"] == COUNTS["clipped"]


def test_assets_lie_beside_the_item(scene, validator, tmp_path):
    item = validated(stac.item(**scene), validator)
    item.set_self_href(str(tmp_path / "out" / "forward" / "item.json"))
    for key, info in scene["files"].items():
        assert item.assets[key].href == f"./{info.path.name}"
        assert item.assets[key].media_type == pystac.MediaType.GEOTIFF
        assert item.assets[key].get_absolute_href() == str(info.path)
    expected = {
        "quicklook": ("./quicklook.png", pystac.MediaType.PNG, ["overview"]),
        "report_json": ("./report.json", pystac.MediaType.JSON, ["metadata"]),
        "report_html": ("./report.html", pystac.MediaType.HTML, ["metadata"]),
        "settings": ("./settings.toml", "application/toml", ["metadata"]),
        "manifest": ("./manifest.json", pystac.MediaType.JSON, ["metadata"]),
    }
    found = {key: asset for key, asset in item.assets.items() if key not in scene["files"]}
    assert {key: (a.href, a.media_type, a.roles) for key, a in found.items()} == expected
    assert item.assets["corrected"].roles == ["data", "reflectance"]
    assert "data-mask" in item.assets["flags"].roles


def test_media_types_are_those_of_the_files(scene, validator):
    assets = validated(stac.item(**scene, cloud_optimised=True), validator).assets
    assert assets["corrected"].media_type == pystac.MediaType.COG
    assert validated(stac.item(**scene), validator).assets["corrected"].media_type == pystac.MediaType.GEOTIFF
    flags = scene["files"]["flags"]
    scene["files"]["flags"] = replace(flags, path=flags.path.with_suffix(".dat"))
    assets = validated(stac.item(**scene), validator).assets
    assert (assets["flags"].href, assets["flags_header"].href) == ("./flags.dat", "./flags.hdr")
    assert (assets["flags"].media_type, assets["flags_header"].media_type) == (
        "application/octet-stream",
        "text/plain",
    )


def test_no_quicklook_where_none_was_drawn(scene):
    assert "quicklook" not in stac.item(**scene, quicklook=False)["assets"]


def test_inputs_are_linked_from_where_the_folder_stands(scene):
    links = stac.item(**scene)["links"]
    assert [(link["rel"], link["href"]) for link in links] == [
        ("derived_from", "../../in/an%20image.tif"),
        ("derived_from", "../../in/dsm.tif"),
    ]
    alone = stac.item(**{**scene, "files": {}})["links"]
    assert [link["href"] for link in alone] == [path.as_uri() for path in scene["inputs"]]


def test_software_is_stated(scene):
    properties = stac.item(**scene)["properties"]
    assert properties["processing:software"] == {"tscorr": "0.1.0"}


def test_time_of_the_sun_is_written_in_utc(scene, validator):
    item = validated(stac.item(**scene), validator)
    assert item.properties["datetime"] == "2026-06-21T10:12:00.000Z"
    assert item.datetime == NOON
    assert item.properties["tscorr:datetime_source"] == "time given for the sun"


def test_time_of_the_tiff_serves_where_the_sun_has_none(scene, validator):
    files = scene["files"]
    tagged = replace(files["corrected"], tags={"TIFFTAG_DATETIME": "2024:05:15 13:30:01"})
    item = validated(stac.item(**{**scene, "datetime": None, "files": {**files, "corrected": tagged}}), validator)
    assert item.datetime == datetime(2024, 5, 15, 13, 30, 1, tzinfo=UTC)
    assert "TIFFTAG_DATETIME" in item.properties["tscorr:datetime_source"]


@pytest.mark.parametrize("tags", [{}, {"TIFFTAG_DATETIME": "yesterday"}])
def test_time_of_last_change_is_the_last_resort_and_says_so(scene, validator, tags):
    changed = datetime(2023, 1, 2, 3, 4, 5, 250000, tzinfo=UTC)
    os.utime(scene["inputs"][0], (changed.timestamp(), changed.timestamp()))
    corrected = replace(scene["files"]["corrected"], tags=tags)
    item = validated(stac.item(**{**scene, "datetime": None, "files": {"corrected": corrected}}), validator)
    assert item.datetime == changed
    assert "time of acquisition is unknown" in item.properties["tscorr:datetime_source"]


def test_collection_spans_its_items(scene, validator, tmp_path):
    east = replace(DELFT, transform=Affine.translation(1000, 0) @ DELFT.transform)
    later = NOON + timedelta(milliseconds=500)
    things = [
        stac.item(**{**scene, "datetime": later}),
        stac.item(**{**scene, "name": "b", "grid": east}),
        stac.item(**{**scene, "name": "c", "grid": replace(DELFT, crs=None)}),
    ]
    thing = stac.collection(title="Delft, three views", items=things)
    collection = validated(thing, validator)
    assert (collection.id, collection.title) == ("delft-three-views", "Delft, three views")
    first, second = things[0]["bbox"], things[1]["bbox"]
    assert collection.extent.spatial.bboxes == [
        [first[0], min(first[1], second[1]), second[2], max(first[3], second[3])]
    ]
    assert collection.extent.temporal.intervals == [[NOON, later]]

    path = tmp_path / "out" / "collection.json"
    path.write_text(json.dumps(thing))
    for item in things:
        (path.parent / item["id"]).mkdir(exist_ok=True)
        (path.parent / item["id"] / "item.json").write_text(json.dumps(item))
    assert [item.id for item in pystac.Collection.from_file(str(path)).get_items()] == ["forward", "b", "c"]


def test_names_that_no_url_holds_are_quoted(scene, validator):
    item = stac.item(**{**scene, "name": "roof #1, ½"})
    collection = validated(stac.collection(title="x", items=[item]), validator)
    assert collection.get_single_link("item").href == "./roof%20%231%2C%20%C2%BD/item.json"


def test_collection_of_nothing_is_valid(validator):
    collection = validated(stac.collection(title="", items=[]), validator)
    assert collection.id == "tscorr"
    assert collection.extent.spatial.bboxes == [[-180, -90, 180, 90]]
    assert collection.extent.temporal.intervals == [[None, None]]
