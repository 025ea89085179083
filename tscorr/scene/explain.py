"""Everything that is known of one pixel: the content of `tscorr explain`."""

from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from tscorr import reference
from tscorr.angles import facet_angles, true_azimuth, zenith_azimuth
from tscorr.correction import SINGLE_FLAGS, SpecularState, class_rows, specular_state
from tscorr.errors import InputError
from tscorr.grid import Block, north_of
from tscorr.scene.plan import Scene
from tscorr.scene.run import Pipeline

NOT_KNOWN = "not known"


def explanation(scene: Scene, row: int, col: int) -> dict[str, dict[str, Any]]:
    """Lines by name, under titles, for a pixel counted from 0; raises InputError outside the image."""
    rows, cols = scene.image.shape
    if not (0 <= row < rows and 0 <= col < cols):
        raise InputError(f"pixel {row} {col} is outside of the image {scene.image.path}, {rows} x {cols}")
    block = Block(row, col, 1, 1)
    with TemporaryDirectory() as folder:
        pipeline = Pipeline(scene, Path(folder))
        with ExitStack() as files:
            pipeline.open(files)
            class_value = pipeline.classes.read(block, 1)
            material_rows = class_rows(class_value, scene.rows)
            stored = pipeline.image.read(block)
            pipeline.ground.prepare(rows=(row, row + 1))
            visible = stored.copy()
            bad = pipeline.bad_bands.set_aside(visible)
            inputs, unseen = pipeline.inputs(block, visible, material_rows, np.ones((1, 1), np.bool_))
            heights = pipeline.ground.surface.heights(block)
        result = pipeline.corrector(inputs, first_row=row)
        pipeline.bad_bands.put_back(result.corrected, bad)
    seen = unseen is None or not unseen.any()
    lines = {
        "pixel": _pixel(scene, row, col, int(class_value[0, 0]), float(heights[0, 0]))
        | (scene.view.describe(scene.grid, block, heights) if seen else {"seen from": NOT_KNOWN}),
        "directions (zenith, azimuth from true north)": _directions(scene, block, inputs)
        | ({} if seen else {"view": NOT_KNOWN}),
    }
    place = int(material_rows[0, 0])
    if place and seen:
        lines |= _model(scene, inputs, place)
    flags = int(result.flags[0, 0])
    state = SpecularState(int(specular_state(result.flags)[0, 0])).name.lower()
    lines["flags"] = {"bits": flags, "state": state, "set": _names(flags)}
    assert result.removed is not None
    lines["reflectance factor: seen, removed, corrected"] = {
        name: _values(scene, b, stored[b, 0, 0], result.removed[b, 0, 0], result.corrected[b, 0, 0])
        for b, name in enumerate(scene.image.names)
    }
    return lines


def _values(scene: Scene, band: int, seen: Any, removed: Any, corrected: Any) -> str:
    """Stored values of a band as reflectance factors, or what stands for no value."""
    scale, offset = scene.stored.scale[band], scene.stored.offset[band]
    no_data = not np.isfinite(seen) or seen == scene.stored.nodata
    values = seen * scale + offset, removed * scale, corrected * scale + offset
    return "no data" if no_data else "  ".join(f"{value:9.5f}" for value in values)


def _names(flags: int) -> str:
    return ", ".join(str(flag.name) for flag in SINGLE_FLAGS if flags & flag) or "none"


def _pixel(scene: Scene, row: int, col: int, class_value: int, height: float) -> dict[str, Any]:
    x, y = scene.grid.xy(row, col)
    place = scene.rows.get(class_value)
    name = "none" if place is None else scene.materials[place - 1][0].name
    return {
        "row, column": f"{row}, {col}",
        "x, y, height [m]": f"{float(x):.2f}, {float(y):.2f}, {height:.2f}",
        "class": class_value,
        "material": name,
    }


def _directions(scene: Scene, block: Block, inputs: Any) -> dict[str, Any]:
    convergence = float(north_of(scene.grid).convergence_deg(block)[0, 0])
    lines = {"meridian convergence": f"{convergence:.4f} degrees"}
    for name in ("sun", "view", "normal"):
        vector = np.asarray(getattr(inputs, name), dtype=float).reshape(3)
        zenith, azimuth = zenith_azimuth(vector)
        components = ", ".join(f"{component:+.6f}" for component in vector)
        azimuth = true_azimuth(azimuth, convergence)
        lines[name] = f"{float(zenith):8.4f} {float(azimuth):9.4f} degrees   east, north, up of the grid: {components}"
    lines["normal from"] = scene.settings.surface.kind
    return lines


def _model(scene: Scene, inputs: Any, place: int) -> dict[str, dict[str, Any]]:
    """Angles about the facet and the factors of equation 1 for each band."""
    vectors = [np.asarray(getattr(inputs, name), dtype=float).reshape(3) for name in ("sun", "view", "normal")]
    angles = facet_angles(*vectors)
    geometry = reference.geometry(*vectors)
    surface, parameters, rules = scene.materials[place - 1]
    simplified = rules.form == "simplified"
    plane = float(geometry.cos_i / vectors[0][2]) if rules.irradiance_plane == "horizontal" else 1.0
    lines: dict[str, dict[str, Any]] = {
        "angles about the facet": {name: f"{float(value):.4f} degrees" for name, value in angles.items()},
        "model": {
            "material": f"{surface.name}, {surface.source}",
            **({} if rules.enabled else {"enabled": "false: nothing is removed"}),
            "form": rules.form,
            "G": f"{float(reference.attenuation(geometry.cos_i, geometry.cos_r, geometry.cos_l)):.6f}",
            "irradiance plane": f"{rules.irradiance_plane}, factor {plane:.5f}",
            "negligible reflectance": rules.negligible_reflectance,
        },
        "band: F, lobe exp(-(w alpha)^2), f_spec, specular reflectance": {},
    }
    for b, name in enumerate(scene.image.names):
        w, n, k = parameters.w[b], parameters.n[b], parameters.k[b]
        f_spec = float(reference.specular(geometry, w, n, k, simplified=simplified))
        removed = np.pi * rules.direct_fraction[b] * parameters.t1[b] * f_spec * plane
        fresnel = float(reference.fresnel(geometry.cos_l, n, k))
        lobe = float(reference.facet_distribution(geometry.alpha, w))
        lines["band: F, lobe exp(-(w alpha)^2), f_spec, specular reflectance"][name] = (
            f"{fresnel:.6f}  {lobe:.6e}  {f_spec:.6e}  {removed:.6f}"
        )
    return lines
