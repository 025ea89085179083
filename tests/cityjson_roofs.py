"""Roofs of a CityJSON model as a raster: height, facet normal and roof face of the top surface.

Written for tests: plain numpy, one triangle at a time.
"""

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.path import Path as Outline


class RoofRaster(NamedTuple):
    heights: np.ndarray  # (rows, cols), the lowest height of the building where there is no roof
    normals: np.ndarray  # (3, rows, cols), east north up
    faces: np.ndarray  # (rows, cols), 0 = ground
    areas: np.ndarray  # area of each face on the ground, [m2]; areas[0] is of no use


def roof_polygons(path):
    """Roof surfaces of each building: a list of lists of rings' lists; vertices in metres."""
    model = json.loads(Path(path).read_text())
    transform = model["transform"]
    vertices = np.array(model["vertices"]) * transform["scale"] + transform["translate"]
    buildings = {}
    for name, item in model["CityObjects"].items():
        owner = item.get("parents", [name])[0]
        for geometry in item.get("geometry", []):
            boundaries = geometry["boundaries"] if geometry["type"] == "MultiSurface" else geometry["boundaries"][0]
            values = geometry["semantics"]["values"]
            values = values if geometry["type"] == "MultiSurface" else values[0]
            for rings, kind in zip(boundaries, values, strict=True):
                if kind is not None and geometry["semantics"]["surfaces"][kind]["type"] == "RoofSurface":
                    buildings.setdefault(owner, []).append([vertices[ring] for ring in rings])
    return list(buildings.values())


def plane_of(ring):
    """Unit normal (up >= 0) and centre of a ring: Newell's formula."""
    centred = ring - ring.mean(axis=0)
    normal = np.cross(centred, np.roll(centred, -1, axis=0)).sum(axis=0)
    length = np.linalg.norm(normal)
    if length == 0:
        return None
    return normal / length * (1 if normal[2] >= 0 else -1), ring.mean(axis=0), length / 2


def rasterise(surfaces, cell_m, margin_m=5.0):
    """Top surface of the roof polygons of one building at the pixel centres."""
    points = np.concatenate([surface[0] for surface in surfaces])
    low, high = points.min(axis=0), points.max(axis=0)
    cols, rows = np.ceil((high - low)[:2] / cell_m + 2 * margin_m / cell_m).astype(int)
    x = low[0] - margin_m + cell_m * (np.arange(cols) + 0.5)
    y = high[1] + margin_m - cell_m * (np.arange(rows) + 0.5)
    grid_x, grid_y = np.meshgrid(x, y)
    centres = np.column_stack([grid_x.ravel(), grid_y.ravel()])
    raster = RoofRaster(
        np.full((rows, cols), low[2] - 5.0),
        np.zeros((3, rows, cols)),
        np.zeros((rows, cols), int),
        np.zeros(len(surfaces) + 1),
    )
    raster.normals[2] = 1.0
    for face, surface in enumerate(surfaces, start=1):
        plane = plane_of(surface[0])
        if plane is None or plane[0][2] < 0.1:
            continue
        normal, centre, area = plane
        inside = Outline(surface[0][:, :2]).contains_points(centres)
        for hole in surface[1:]:
            inside &= ~Outline(hole[:, :2]).contains_points(centres)
        inside = inside.reshape(rows, cols)
        height = centre[2] - ((grid_x - centre[0]) * normal[0] + (grid_y - centre[1]) * normal[1]) / normal[2]
        top = inside & (height > raster.heights)
        raster.heights[top] = height[top]
        raster.normals[:, top] = normal[:, None]
        raster.faces[top] = face
        raster.areas[face] = area * normal[2]
    return raster


def angle_deg(first, second):
    """Angle between unit vectors (3, ...). [deg]"""
    return np.rad2deg(2.0 * np.arcsin(np.clip(np.linalg.norm(first - second, axis=0) / 2.0, 0.0, 1.0)))
