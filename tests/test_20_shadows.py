"""Shadows and occlusion against closed forms, an independent fine march, and ray-traced truth."""

import csv
import itertools
import json
import math
from pathlib import Path

import numpy as np
import pytest
import rasterio
from scipy.ndimage import binary_dilation, map_coordinates, maximum_filter, minimum_filter

from tscorr.errors import InputError
from tscorr.terrain import sightlines
from tscorr.terrain.shadows import DirectionSweep, FrameSweep, LineSweep, PenumbraSweep, march, reach_m

DELFT = Path(__file__).parents[1] / "samples" / "delft"
HALF_METRE = {"cell_x_m": 0.5, "cell_y_m": 0.5}


def direction(zenith_deg, azimuth_deg):
    zenith, azimuth = math.radians(zenith_deg), math.radians(azimuth_deg)
    horizontal = math.sin(zenith)
    return np.array([horizontal * math.sin(azimuth), horizontal * math.cos(azimuth), math.cos(zenith)])


def swept(sweep, heights, lines=64):
    visible = np.ones(heights.shape, bool)
    for strip in sweep.strips(lines):
        visible[strip.slices] &= sweep(strip, heights[strip.slices])
    return visible


def lit(heights, sun, lines=64, **cells):
    return swept(DirectionSweep(heights.shape, sun, **(cells or HALF_METRE)), heights, lines)


def positions(shape, cell_x_m=0.5, cell_y_m=0.5):
    row, col = np.mgrid[: shape[0], : shape[1]]
    return np.stack([col * cell_x_m, -row * cell_y_m])


def views(heights, sensor, **cells):
    """Vectors from the surface to a sensor at one position (3,) or at one for each pixel."""
    sensor = np.asarray(sensor, float).reshape(3, *(np.shape(sensor)[1:] or (1, 1)))
    return sensor - np.stack([*positions(heights.shape, **cells), heights])


def abeam(heights, start, heading):
    """The point of a straight trajectory abeam of each pixel."""
    start, heading = np.asarray(start, float), np.asarray(heading, float) / np.hypot(*heading[:2])
    east, north = positions(heights.shape)
    run = (east - start[0]) * heading[0] + (north - start[1]) * heading[1]
    return start[:, None, None] + heading[:, None, None] * run


# -- a synthetic city whose heights are known everywhere, not only at pixel centres


CITY_CELL_M = 0.25
CITY_PX = 320


def city_height(east, north):
    """Boxes and gables at any angle on a gentle slope, in the south-east quadrant of the origin."""
    rng = np.random.default_rng(5)
    height = 2.0 + 0.02 * east + 0.0 * north
    centres = []
    while len(centres) < 8:
        x, y = rng.uniform(10, 70), -rng.uniform(10, 70)
        turn, length, width = rng.uniform(0, np.pi), rng.uniform(8, 18), rng.uniform(6, 12)
        eave, slope = rng.uniform(3, 15), rng.choice([0.0, 0.4, 0.8])
        if any(math.hypot(x - a, y - b) < 18 for a, b in centres):
            continue
        centres.append((x, y))
        u = (east - x) * math.cos(turn) + (north - y) * math.sin(turn)
        v = (north - y) * math.cos(turn) - (east - x) * math.sin(turn)
        inside = (np.abs(u) < length / 2) & (np.abs(v) < width / 2)
        height = np.where(inside, 2.0 + eave + slope * (width / 2 - np.abs(v)), height)
    return height


@pytest.fixture(scope="module")
def city():
    return city_height(*positions((CITY_PX, CITY_PX), CITY_CELL_M, CITY_CELL_M)).astype(np.float32)


@pytest.fixture(scope="module")
def exact_look():
    """The city's own height at fractional (row, col), from a grid 8 times finer."""
    fine = 8
    index = (np.arange(CITY_PX * fine) + 0.5) / fine - 0.5
    height = city_height(index[None, :] * CITY_CELL_M, -index[:, None] * CITY_CELL_M)

    def look(row, col):
        i, j = (np.floor((x + 0.5) * fine).astype(int) for x in (row, col))
        return height[np.clip(i, 0, len(height) - 1), np.clip(j, 0, len(height) - 1)]

    return look


def fine_march(heights, look, toward, cell_m, step_m):
    """From the definition: free if no point of the ray above the map is under the surface `look`."""
    row, col = (x.ravel().astype(float) for x in np.indices(heights.shape))
    toward = np.broadcast_to(np.asarray(toward).reshape(3, *(np.shape(toward)[1:] or (1, 1))), (3, *heights.shape))
    east, north, up = (toward / np.maximum(np.hypot(toward[0], toward[1]), 1e-9)).reshape(3, -1)
    eye, top = heights.ravel().astype(float) + 1e-3, heights.max()
    free, going = np.ones(row.size, bool), np.arange(row.size)
    run = 0.0
    while going.size:
        run += step_m
        r, c = row[going] - north[going] * run / cell_m, col[going] + east[going] * run / cell_m
        ray = eye[going] + up[going] * run
        inside = (np.abs(r / heights.shape[0] - 0.5) < 0.5) & (np.abs(c / heights.shape[1] - 0.5) < 0.5)
        inside &= ray < top
        going, r, c, ray = going[inside], r[inside], c[inside], ray[inside]
        hit = look(r, c) > ray
        free[going[hit]] = False
        going = going[~hit]
    return free.reshape(heights.shape)


@pytest.mark.parametrize(("zenith_deg", "azimuth_deg"), [(20, 137), (40, 30), (60, 250), (60, 90), (70, 180)])
def test_city_shadows_are_those_of_an_independent_march(city, exact_look, zenith_deg, azimuth_deg):
    sun, cells = direction(zenith_deg, azimuth_deg), {"cell_x_m": CITY_CELL_M, "cell_y_m": CITY_CELL_M}

    def bilinear(row, col):
        return map_coordinates(city.astype(float), [row, col], order=1, mode="nearest")

    sweep = lit(city, sun, **cells)
    over_dsm = fine_march(city, bilinear, sun, CITY_CELL_M, 0.125)
    over_city = fine_march(city, exact_look, sun, CITY_CELL_M, 0.05)
    assert 0.02 < (~over_city).mean() < 0.6
    assert (sweep == over_dsm).mean() >= 0.99
    assert (sweep == over_city).mean() >= 0.99
    assert (sweep == march(city, sun, **cells)).mean() >= 0.99


def test_walls_midway_come_closer_to_the_city_than_its_bilinear_surface(city, exact_look):
    coarse = city[1::2, 1::2]
    sun, cell_m = direction(40, 30), 2 * CITY_CELL_M

    def city_at(row, col):
        return exact_look(2 * row + 1, 2 * col + 1)

    def bilinear(row, col):
        return map_coordinates(coarse.astype(float), [row, col], order=1, mode="nearest")

    truth = fine_march(coarse, city_at, sun, cell_m, 0.05)
    of_sweep = (lit(coarse, sun, cell_x_m=cell_m, cell_y_m=cell_m) == truth).mean()
    of_bilinear = (fine_march(coarse, bilinear, sun, cell_m, 0.125) == truth).mean()
    assert 1 - of_sweep < 0.75 * (1 - of_bilinear)


@pytest.mark.parametrize("position", [(40.0, -40.0, 250.0), (130.0, 40.0, 200.0), (0.0, 0.0, 150.0)])
def test_city_seen_by_a_frame(city, exact_look, position):
    cells = {"cell_x_m": CITY_CELL_M, "cell_y_m": CITY_CELL_M}
    toward = views(city, position, **cells)
    truth = fine_march(city, exact_look, toward, CITY_CELL_M, 0.05)
    sweep = swept(FrameSweep(city.shape, position, **cells), city)
    assert (sweep == truth).mean() >= 0.99
    assert (sweep == march(city, toward, **cells)).mean() >= 0.99


# -- the ray-traced sample


def read(name):
    with rasterio.open(DELFT / name) as dataset:
        return dataset.read()


@pytest.fixture(scope="module")
def delft():
    with rasterio.open(DELFT / "dsm.tif") as dataset:
        transform = dataset.transform
    x0, y0 = transform.c + transform.a / 2, transform.f + transform.e / 2
    return {
        "heights": {"exact": read("dsm.tif")[0], "noisy": read("dsm_noisy.tif")[0]},
        "normals": read("truth/normals.tif").astype(float),
        "origin": np.array([x0, y0, 0.0]),
        "angles": json.loads((DELFT / "truth/angles.json").read_text()),
        "frames": json.loads((DELFT / "cameras.json").read_text())["frames"],
    }


def agreement(visible, truth):
    """Share of equal pixels: of all, and of those more than 2 pixels from an edge of the truth."""
    edge = maximum_filter(truth, 3) != minimum_filter(truth, 3)
    near = binary_dilation(edge, np.ones((3, 3), bool))
    return (visible == truth).mean(), (visible == truth)[~near].mean()


def facing(delft, toward):
    toward = np.reshape(toward, (3, *(np.shape(toward)[1:] or (1, 1))))
    return (delft["normals"] * toward).sum(axis=0) > 0


@pytest.mark.parametrize("surface", ["exact", "noisy"])
def test_delft_shadows(delft, surface):
    heights = delft["heights"][surface]
    sun = np.array(delft["angles"]["sun"]["unit_vector_to_sun_grid"])
    truth = read("truth/shadow.tif")[0] == 1
    for visible in (lit(heights, sun), march(heights, sun, **HALF_METRE)):
        everywhere, away = agreement(visible & facing(delft, sun), truth)
        assert everywhere >= 0.978
        assert away >= 0.996


@pytest.mark.parametrize("surface", ["exact", "noisy"])
@pytest.mark.parametrize(("frame", "least"), [("forward", 0.978), ("nadir", 0.990)])
def test_delft_frames(delft, surface, frame, least):
    heights = delft["heights"][surface]
    position = np.array([delft["frames"][frame][axis] for axis in "xyz"]) - delft["origin"]
    toward = views(delft["heights"]["exact"], position)
    truth = read(f"truth/view_visible_{frame}.tif")[0] == 1
    sweep = swept(FrameSweep(heights.shape, position, **HALF_METRE), heights, 100)
    for visible in (sweep, march(heights, toward, **HALF_METRE)):
        everywhere, away = agreement(visible & facing(delft, toward), truth)
        assert everywhere >= least
        assert away >= 0.996


@pytest.mark.parametrize("surface", ["exact", "noisy"])
def test_delft_line(delft, surface):
    heights = delft["heights"][surface]
    with (DELFT / "trajectory.csv").open() as file:
        track = np.array([[float(point[axis]) for axis in "xyz"] for point in csv.DictReader(file)])
    start, end = track[0] - delft["origin"], track[-1] - delft["origin"]
    toward = abeam(heights, start, end - start) - np.stack([*positions(heights.shape), heights])
    truth = read("truth/view_visible_line.tif")[0] == 1
    sweep = swept(LineSweep(heights.shape, start, end, **HALF_METRE), heights, 100)
    for visible in (sweep, march(heights, toward, **HALF_METRE)):
        everywhere, away = agreement(visible & facing(delft, toward), truth)
        assert everywhere >= 0.988
        assert away >= 0.999


# -- closed forms


@pytest.mark.parametrize(("azimuth_deg", "row_step", "col_step"), [(180, -1, 0), (0, 1, 0), (90, 0, -1), (270, 0, 1)])
@pytest.mark.parametrize("cells", [(0.5, 0.5), (0.4, 1.0), (2.0, 0.5)])
def test_a_tower_in_the_sun_casts_its_shadow_away_from_it(azimuth_deg, row_step, col_step, cells):
    """In words: the sun in the south, the shadow in the north, as long as height times tan(zenith)."""
    heights = np.zeros((81, 81), np.float32)
    heights[40, 40] = 10.0
    cells = {"cell_x_m": cells[0], "cell_y_m": cells[1]}
    sun = direction(40, azimuth_deg)
    cell_m = cells["cell_y_m"] if row_step else cells["cell_x_m"]
    reach_px = (10.0 - 0.05) * math.tan(math.radians(40)) / cell_m + 0.5  # the wall stands half a pixel off
    steps = range(1, math.floor(reach_px) + 1)
    expected = [(40 + row_step * n, 40 + col_step * n) for n in steps]
    for visible in (lit(heights, sun, **cells), march(heights, sun, **cells)):
        assert sorted(map(tuple, np.argwhere(~visible).tolist())) == sorted(expected)


@pytest.mark.parametrize(("azimuth_deg", "cells"), [(180, (0.4, 1.0)), (270, (1.0, 0.4))])
def test_a_step_is_a_wall_only_if_it_is_steeper_than_roofs(azimuth_deg, cells):
    """1.5 m over 1 m: the step ends at its pixel's centre; a wall midway would darken a second pixel."""
    cells = {"cell_x_m": cells[0], "cell_y_m": cells[1]}
    heights = np.zeros((21, 21), np.float32)
    heights[10, 10] = 1.5
    sun = direction(50, azimuth_deg)
    dark = [(9, 10)] if azimuth_deg == 180 else [(10, 11)]
    for visible in (lit(heights, sun, **cells), march(heights, sun, **cells)):
        assert list(map(tuple, np.argwhere(~visible).tolist())) == dark


@pytest.mark.parametrize("azimuth_deg", [45, 135, 225, 315])
def test_a_diagonal_shadow_follows_the_diagonal_of_real_cells(azimuth_deg):
    heights = np.zeros((81, 121), np.float32)
    heights[40, 60] = 10.0
    row, col = np.nonzero(~lit(heights, direction(50, azimuth_deg), cell_x_m=0.5, cell_y_m=1.0))
    east, north = (col - 60) * 0.5, (40 - row) * 1.0
    away = -direction(90, azimuth_deg)[:2]
    assert len(row) > 5
    assert np.all(east * away[0] + north * away[1] > 0)
    assert np.all(np.abs(north * away[0] - east * away[1]) <= 0.75)
    assert np.hypot(east, north).max() == pytest.approx(10.0 * math.tan(math.radians(50)), abs=1.0)


def test_a_scanner_in_the_east_does_not_see_the_ground_west_of_a_wall():
    heights = np.zeros((30, 200), np.float32)
    heights[:, 100] = 20.0
    visible = swept(LineSweep(heights.shape, (80.0, 0.0, 100.0), (80.0, -10.0, 100.0), **HALF_METRE), heights)
    # from 80 m east and 100 m high over the wall's west side at 49.75 m the line of sight meets the ground
    grounds_m = 80.0 - (80.0 - 49.75) * 100.0 / (100.0 - 20.0)
    east = np.arange(200) * 0.5
    hidden = (east < 49.9) & (east > grounds_m + 0.1)
    assert np.array_equal(visible, np.broadcast_to(~hidden, visible.shape))


def test_trajectory_and_frame_hide_nothing_below_them():
    heights = np.zeros((40, 40), np.float32)
    heights[10:20, 10:20] = 5.0
    visible = swept(FrameSweep(heights.shape, (7.5, -7.5, 500.0), **HALF_METRE), heights)
    assert visible.all()
    start, end = (7.5, 0.0, 500.0), (7.5, -1.0, 500.0)
    assert swept(LineSweep(heights.shape, start, end, **HALF_METRE), heights).all()


def test_a_void_hides_nothing_and_is_seen():
    heights = np.zeros((60, 60), np.float32)
    heights[30, 20:40] = 30.0
    heights[30, 25:35] = np.nan
    sun = direction(45, 180)
    for visible in (lit(heights, sun), march(heights, sun, **HALF_METRE)):
        assert visible[np.isnan(heights)].all()
        assert visible[5:30, 27:33].all()
        assert not visible[5:30, 21:24].any()


def test_penumbra_is_the_visible_share_of_the_disk():
    heights = np.zeros((400, 3), np.float32)
    heights[380:] = 50.0
    sweep = PenumbraSweep(heights.shape, direction(60, 180), **HALF_METRE, tolerance_m=0.0, slices=41)
    share = np.full(heights.shape, np.nan, np.float32)
    for strip in sweep.strips(50):
        share[strip.slices] = sweep(strip, heights[strip.slices])
    wall_m = (379.5 - np.arange(380)) * 0.5
    above_edge_deg = 30.0 - np.rad2deg(np.arctan2(50.0, wall_m))  # of the disk's centre above the wall's edge
    y = np.clip(above_edge_deg / 0.267, -1.0, 1.0)
    expected = 0.5 + (y * np.sqrt(1 - y**2) + np.arcsin(y)) / math.pi
    assert ((expected > 0.02) & (expected < 0.98)).sum() >= 3
    np.testing.assert_allclose(share[:380], np.broadcast_to(expected[:, None], (380, 3)), atol=0.03)


# -- laws


@pytest.fixture(scope="module")
def rough():
    rng = np.random.default_rng(11)
    heights = rng.normal(0, 0.1, (97, 131)).astype(np.float32)
    for _ in range(40):
        row, col = rng.integers(0, 90), rng.integers(0, 120)
        heights[row : row + rng.integers(2, 15), col : col + rng.integers(2, 15)] += rng.uniform(2, 12)
    heights[rng.random(heights.shape) < 0.02] = np.nan
    heights[:7, :9] = np.nan
    return heights


def sweeps_of(shape):
    cells = {"cell_x_m": 0.5, "cell_y_m": 0.7}
    for azimuth_deg in (0, 10, 80, 90, 150, 200, 290, 359.99):
        yield lambda azimuth_deg=azimuth_deg: DirectionSweep(shape, direction(55, azimuth_deg), **cells)
    for end in ((20.0, -30.0, 80.0), (21.0, -31.0, 82.0), (20.5, 40.0, 80.0), (-300.0, -40.0, 95.0)):
        yield lambda end=end: LineSweep(shape, (20.0, -31.0, 80.0), end, **cells)
    for position in ((20.0, -30.1, 60.0), (30.0, -35.0, 90.0), (-40.0, -20.0, 90.0), (150.0, 60.0, 120.0)):
        yield lambda position=position: FrameSweep(shape, position, **cells)


def test_strips_of_any_height_give_the_same_bits(rough):
    for make in sweeps_of(rough.shape):
        whole = swept(make(), rough, 1000)
        assert 0.3 < whole.mean() < 1.0
        for lines in (1, 7, 32, 50):
            assert np.array_equal(swept(make(), rough, lines), whole)


def test_the_parts_of_a_sweep_side_by_side_see_what_it_sees(rough):
    for make in sweeps_of(rough.shape):
        parts, together = make().parts()[::-1], np.ones(rough.shape, bool)
        for strips in itertools.zip_longest(*(part.strips(16) for part in parts)):
            for part, strip in zip(parts, strips, strict=True):
                if strip is not None:
                    together[strip.slices] &= part(strip, rough[strip.slices])
        np.testing.assert_array_equal(together, swept(make(), rough))


def test_strips_lie_between_multiples_of_their_depth_and_none_is_empty(rough):
    for make in sweeps_of(rough.shape):
        sweep = make()
        for strip in sweep.strips(32):
            assert min(strip.height, strip.width) > 0
            rows = strip.row // 32 == (strip.row + strip.height - 1) // 32
            cols = strip.col // 32 == (strip.col + strip.width - 1) // 32
            assert rows or cols
            assert strip.row + strip.height <= rough.shape[0]
            assert strip.col + strip.width <= rough.shape[1]


def test_march_gives_the_same_bits_for_any_window_with_its_halo(rough):
    sensor = (20.0, -30.0, 120.0)
    toward = views(np.nan_to_num(rough), sensor)
    whole = march(rough, toward, **HALF_METRE)
    halo = math.ceil(reach_m(float(np.nanmax(rough) - np.nanmin(rough)), 60.0) / 0.5) + 1
    for rows, cols in ((slice(30, 60), slice(40, 75)), (slice(0, 13), slice(100, 131))):
        top, left = max(rows.start - halo, 0), max(cols.start - halo, 0)
        part = rough[top : rows.stop + halo, left : cols.stop + halo]
        window = slice(rows.start - top, rows.stop - top), slice(cols.start - left, cols.stop - left)
        needed = np.zeros((rows.stop - rows.start, cols.stop - cols.start), bool)
        needed[::2] = True
        found = march(part, toward[:, rows, cols], window=window, needed=needed, **HALF_METRE)
        assert np.array_equal(found, whole[rows, cols] | ~needed)


def test_skipping_tiles_changes_nothing(rough, monkeypatch):
    sun = direction(70, 123)
    skipped = march(rough, sun, **HALF_METRE)

    same = np.full_like(sightlines.peaks(rough), np.nanmax(rough))
    monkeypatch.setattr(sightlines, "peaks", lambda _: same)
    assert np.array_equal(march(rough, sun, **HALF_METRE), skipped)


def test_turning_scene_and_sun_together_turns_the_shadow(rough):
    shadow = lit(rough, direction(60, 70))
    for turns in (1, 2, 3):
        turned = lit(np.rot90(rough, turns), direction(60, 70 - 90 * turns))
        assert (np.rot90(turned, -turns) == shadow).mean() > 0.999


def test_a_sensor_far_away_sees_as_a_direction_does(rough):
    far = direction(50, 200) * 1e5
    parallel = lit(rough, far)
    assert (swept(FrameSweep(rough.shape, far, **HALF_METRE), rough) == parallel).mean() > 0.99
    along = [far[0] + far[1], far[1] - far[0], far[2]]
    assert (swept(LineSweep(rough.shape, far, along, **HALF_METRE), rough) == parallel).mean() > 0.99


def test_sweeps_see_what_the_march_sees(rough):
    heights = np.where(np.isnan(rough), np.float32(0), rough)
    for position in ((30.0, -20.0, 90.0), (30.25, -20.25, 40.0), (-60.0, -20.0, 90.0), (30.0, 90.0, 120.0)):
        swept_ = swept(FrameSweep(heights.shape, position, **HALF_METRE), heights)
        assert (swept_ == march(heights, views(heights, position), **HALF_METRE)).mean() > 0.985
    for start, end in (
        ((10, -20, 60), (30, -25, 62)),
        ((10, -80, 90), (70, -100, 85)),
        ((30, 0, 50), (30, -9, 50)),
    ):
        sensor = abeam(heights, start, np.subtract(end, start))
        swept_ = swept(LineSweep(heights.shape, start, end, **HALF_METRE), heights)
        assert (swept_ == march(heights, views(heights, sensor), **HALF_METRE)).mean() > 0.985


def test_height_above_the_datum_does_not_matter(rough):
    heights = np.round(rough * 128) / np.float32(128)  # exact in float32 after the shift
    for shift in (np.float32(4096), np.float32(-512)):
        for azimuth_deg in (20, 250):
            sun = direction(65, azimuth_deg)
            assert np.array_equal(lit(heights + shift, sun), lit(heights, sun))


@pytest.mark.parametrize("zenith_deg", [60, 75, 80, 85])
def test_noise_speckles_flat_ground_only_where_it_stands_above_the_ray(zenith_deg):
    sigma_m, rise_m = 0.03, 0.5 / math.tan(math.radians(zenith_deg))
    heights = np.random.default_rng(2).normal(100, sigma_m, (500, 500)).astype(np.float32)
    above = (np.arange(1, 50) * rise_m + 0.05) / (2 * sigma_m)  # normal tail of the difference of two heights
    expected = sum(0.5 * math.erfc(x) for x in above)
    for azimuth_deg in (0, 33, 90):
        speckle = (~lit(heights, direction(zenith_deg, azimuth_deg))).mean()
        assert speckle <= 1.2 * expected + 2e-5
        assert zenith_deg == 85 or speckle <= 1e-3


# -- the ends of the domain


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1), (2, 3), (50, 40)])
@pytest.mark.parametrize("fill", ["flat", "steps", "void", "half void"])
def test_stress(shape, fill):
    rng = np.random.default_rng(1)
    heights = np.zeros(shape, np.float32)
    if fill == "steps":
        heights = (300.0 * rng.integers(0, 2, shape)).astype(np.float32)
    elif fill != "flat":
        heights[rng.random(shape) < (0.5 if fill == "half void" else 2)] = np.nan
    for azimuth_deg in (0, 1e-9, 45, 89.999999, 90, 90.000001, 180, 270, 359.9999999, 360):
        for zenith_deg in (0, 1e-12, 1e-3, 45, 89.9):
            sun = direction(zenith_deg, azimuth_deg)
            for visible in (
                lit(heights, sun, 16, cell_x_m=0.3, cell_y_m=4.0),
                march(heights, sun, **HALF_METRE),
            ):
                assert visible.dtype == bool
                assert visible[np.isnan(heights)].all()
                if fill != "steps" or zenith_deg <= 1e-12:
                    assert visible.all()
                else:
                    assert visible[heights == heights.max()].all()
    for position in ((0.0, 0.0, 500.0), (3.0, -2.0, 301.0), (-1e5, 1e5, 1e5), (0.15, -2.0, 1000.0)):
        frame = FrameSweep(shape, position, cell_x_m=0.3, cell_y_m=4.0)
        end = (position[0] + 0.1, position[1] - 0.2, position[2])
        line = LineSweep(shape, position, end, cell_x_m=0.3, cell_y_m=4.0)
        for sweep in (frame, line):
            visible = swept(sweep, heights, 16)
            assert visible[np.isnan(heights)].all()
            assert fill == "steps" or visible.all()


def test_the_zenith_asks_for_no_strips():
    assert not list(DirectionSweep((9, 9), (0.0, 0.0, 1.0), **HALF_METRE).strips(4))


def test_a_march_sees_nothing_at_the_horizon_below_it_and_towards_nan():
    heights = np.zeros((2, 3), np.float32)
    toward = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [np.nan, np.nan, np.nan]]).T
    toward = np.broadcast_to(toward[:, None, :], (3, 2, 3))
    assert march(heights, toward, **HALF_METRE).tolist() == [[True, False, False]] * 2


@pytest.mark.parametrize("up", [0.0, -0.3])
@pytest.mark.parametrize("sweep", [DirectionSweep, PenumbraSweep])
def test_a_source_below_the_horizon_is_refused(sweep, up):
    with pytest.raises(InputError, match="above the horizon"):
        sweep((9, 9), (0.5, 0.5, up), **HALF_METRE)


def test_impossible_input_is_refused():
    sun = direction(40, 30)
    for cells in ((0.0, 1.0), (1.0, -1.0), (np.nan, 1.0), (1.0, np.inf)):
        with pytest.raises(InputError, match="cells"):
            DirectionSweep((9, 9), sun, cell_x_m=cells[0], cell_y_m=cells[1])
    with pytest.raises(InputError, match="three finite numbers"):
        DirectionSweep((9, 9), (np.nan, 0.0, 1.0), **HALF_METRE)
    with pytest.raises(InputError, match="at least one row"):
        FrameSweep((0, 9), (0.0, 0.0, 500.0), **HALF_METRE)
    with pytest.raises(InputError, match="heading"):
        LineSweep((9, 9), (1.0, 2.0, 500.0), (1.0, 2.0, 600.0), **HALF_METRE)
    with pytest.raises(InputError, match="tolerance_m"):
        march(np.zeros((4, 4), np.float32), sun, **HALF_METRE, tolerance_m=-1.0)
    with pytest.raises(InputError, match="direction has shape"):
        march(np.zeros((4, 4), np.float32), np.zeros((3, 4, 5)), **HALF_METRE)


def test_strips_out_of_turn_are_refused():
    sweep = DirectionSweep((9, 9), direction(40, 30), **HALF_METRE)
    first, second, *_ = sweep.strips(3)
    heights = np.zeros((3, 9), np.float32)
    with pytest.raises(InputError, match="out of turn"):
        sweep(second, heights)
    sweep(first, heights)
    with pytest.raises(InputError, match="out of turn"):
        sweep(first, heights)
    with pytest.raises(InputError, match="shape"):
        sweep(second, heights[:, 1:])
