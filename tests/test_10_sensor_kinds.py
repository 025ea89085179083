"""Line scanners with attitude, turns and repeated passes; rasters of angles; orthomosaics; all from the definition."""

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from affine import Affine
from rasterio.crs import CRS
from scipy.optimize import brentq

from tscorr.angles import angle_between, relative_azimuth, unit_vector, zenith_azimuth
from tscorr.errors import InputError
from tscorr.grid import Block, Grid, convergence_deg, convergences_deg, north_of
from tscorr.sensor import (
    ConstantView,
    FrameView,
    LineView,
    MosaicView,
    RasterView,
    Trajectory,
    angle_vectors,
    check_angles,
    read_cameras,
    read_trajectory,
)

GRID = Grid(CRS.from_epsg(28992), Affine(0.5, 0, 84664, 0, -0.5, 447719), (96, 128))
CENTER = np.array([*GRID.center, 0.0])
WHOLE = Block(0, 0, *GRID.shape)
START = datetime(2024, 5, 15, 13, 30, tzinfo=UTC)


def ground_of(block=WHOLE, grid=GRID):
    """Map coordinates (2, rows, cols) of pixel centres, by hand."""
    rows, cols = np.mgrid[block.slices]
    a = grid.transform
    return np.stack([a.c + a.a * (cols + 0.5), a.f + a.e * (rows + 0.5)])


def held(values):
    """A function that reads the same values whatever it is asked for."""
    return lambda *_: values


def heights_of(block=WHOLE, seed=0):
    """Ground and boxes of up to 300 m, (rows, cols) float32; the same for a pixel in any block."""
    rng = np.random.default_rng(seed)
    whole = np.where(rng.random(GRID.shape) < 0.2, rng.uniform(0, 300, GRID.shape), rng.uniform(0, 1, GRID.shape))
    return whole[block.slices].astype(np.float32)


def flight(seconds, position, heading_deg, pitch_deg=0.0):
    """A trajectory from arrays; positions (3, samples), heading from grid north."""
    seconds = np.asarray(seconds, dtype=float)
    forward = unit_vector(
        90.0 - np.broadcast_to(pitch_deg, seconds.shape), np.broadcast_to(heading_deg, seconds.shape)
    )
    return Trajectory(START, seconds, *position, forward, "flight.csv")


def body_to_grid(roll_deg, pitch_deg, heading_deg):
    """Rotation from nose, right wing, down to east, north, up: heading, then pitch, then roll (aerospace 3-2-1)."""
    r, p, h = np.deg2rad([roll_deg, pitch_deg, heading_deg])
    about_x = np.array([[1, 0, 0], [0, np.cos(r), -np.sin(r)], [0, np.sin(r), np.cos(r)]])
    about_y = np.array([[np.cos(p), 0, np.sin(p)], [0, 1, 0], [-np.sin(p), 0, np.cos(p)]])
    about_z = np.array([[np.cos(h), -np.sin(h), 0], [np.sin(h), np.cos(h), 0], [0, 0, 1]])
    north_east_down = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    return north_east_down @ about_z @ about_y @ about_x


def test_attitude_in_words():
    """Nose north. Heading 90 points it east, pitch 90 points it up, roll 90 points the right wing down."""
    np.testing.assert_allclose(body_to_grid(0, 0, 90) @ [1, 0, 0], [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(body_to_grid(0, 90, 0) @ [1, 0, 0], [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(body_to_grid(90, 0, 0) @ [0, 1, 0], [0, 0, -1], atol=1e-15)


def test_a_scan_line_by_hand(tmp_path):
    """Where the rays of a scan line hit the ground, with full attitude, is seen from where they started.

    One attitude for the whole line, so that it is known exactly at any time: heading 37 on a track of 30,
    nose 4 degrees up, right wing 11 degrees down.
    """
    attitude = {"roll_deg": 11.0, "pitch_deg": 4.0, "heading_deg": 37.0}
    turn = body_to_grid(**attitude)
    step = 6.0 * unit_vector(90.0, 30.0)
    samples = np.arange(-150, 150)[:, None] * step + CENTER + [0, 0, 900.0]
    # the file holds headings from true north, each at its own place
    heading = attitude["heading_deg"] + convergences_deg(GRID, samples[:, 0], samples[:, 1])
    rows = [
        f"{(START + timedelta(seconds=0.1 * i)).isoformat()},{x!r},{y!r},{z!r},11.0,4.0,{h!r}"
        for i, ((x, y, z), h) in enumerate(zip(samples.tolist(), heading.tolist(), strict=True))
    ]
    path = tmp_path / "flight.csv"
    path.write_text("\n".join(["utc,x,y,z,roll_deg,pitch_deg,heading_deg", *rows]))
    line = LineView(read_trajectory(path, GRID))
    for index in (120.0, 149.3, 175.75):
        sensor = CENTER + [0, 0, 900.0] + (index - 150) * step
        for scan_angle in np.deg2rad([-35, -11, 0.0, 20, 33]):
            ray = turn @ [0, np.sin(scan_angle), np.cos(scan_angle)]
            hit = sensor + ray * (12.0 - sensor[2]) / ray[2]
            seconds, vectors = line._passes(*(np.full((1, 1), value) for value in hit))
            assert seconds[0, 0] == pytest.approx(0.1 * index, abs=1e-7)
            assert angle_between(vectors[:, 0, 0], -ray) < 1e-6


def rough_flight(seed=5, count=400):
    """Uneven time steps, wind, wobbling attitude; about 25 m/s to the north-east over the grid."""
    rng = np.random.default_rng(seed)
    seconds = np.cumsum(rng.uniform(0.02, 0.2, count))
    seconds -= seconds[0]
    along = 25 * (seconds - seconds[-1] / 2)
    aside = 3 * np.sin(seconds / 3)
    track = np.deg2rad(48)
    x = CENTER[0] + along * np.sin(track) + aside * np.cos(track)
    y = CENTER[1] + along * np.cos(track) - aside * np.sin(track)
    z = 700 + 2 * np.cos(seconds / 5)
    heading = 48 + 2 * np.sin(seconds / 4)
    return flight(seconds, (x, y, z), heading, 1 + 0.5 * np.sin(seconds / 2.5))


def seen_by_root_finding(path, point):
    """Direction to the sensor of the nearest time at which a point lies in the scan plane: every root by brentq."""

    def ahead(second):
        position, forward = path.at(np.array(second))
        return float((point - position) @ forward)

    at_samples = [ahead(second) for second in path.seconds]
    found = []
    for k, second in enumerate(path.seconds[:-1]):
        if at_samples[k] > 0 >= at_samples[k + 1]:
            root = brentq(ahead, second, path.seconds[k + 1], xtol=1e-13, rtol=1e-14)
            away = path.at(np.array(root))[0] - point
            found.append((np.linalg.norm(away), root, away / np.linalg.norm(away)))
    return min(found, key=lambda item: item[:2])[1:]


def test_every_pixel_is_seen_as_root_finding_says():
    path = rough_flight()
    line, heights = LineView(path), heights_of()
    look = line.look(GRID, WHOLE, heights)
    assert look.unseen is None
    x, y = ground_of()
    rng = np.random.default_rng(6)
    for row, col in zip(rng.integers(0, 96, 120), rng.integers(0, 128, 120), strict=True):
        second, vector = seen_by_root_finding(path, np.array([x[row, col], y[row, col], heights[row, col]]))
        assert look.seconds[row, col] == pytest.approx(second, abs=1e-9)
        assert angle_between(look.vectors[:, row, col], vector) < 1e-7


@pytest.mark.parametrize(
    "block", [Block(0, 0, 1, 1), Block(95, 127, 1, 1), Block(17, 0, 1, 128), Block(33, 50, 40, 21)]
)
def test_a_block_of_a_line_is_a_piece_of_the_whole(block):
    """Bit by bit, under towers of 300 m too."""
    line, whole = LineView(rough_flight()), LineView(rough_flight()).look(GRID, WHOLE, heights_of())
    look = line.look(GRID, block, heights_of(block))
    np.testing.assert_array_equal(look.vectors, whole.vectors[:, *block.slices])
    np.testing.assert_array_equal(look.seconds, whole.seconds[block.slices])


def two_lines(apart=200.0, back=True):
    """Over the grid to the north, a half circle beyond it, and back so many metres to the east. 10 m/s."""
    along = np.arange(-300.0, 300.0, 5.0)
    circle = np.arange(0, np.pi, 0.05)
    x = np.concatenate([0 * along, apart / 2 * (1 - np.cos(circle)), 0 * along + apart])
    y = np.concatenate([along, 300 + apart / 2 * np.sin(circle), -along])
    heading = np.concatenate([0 * along, np.rad2deg(circle), 0 * along + 180])
    count = len(x) if back else len(along) + len(circle)
    seconds = np.concatenate([[0], np.cumsum(np.hypot(np.diff(x), np.diff(y)) / 10)])
    position = (CENTER[0] + x[:count], CENTER[1] + y[:count], np.full(count, 400.0))
    return flight(seconds[:count], position, heading[:count])


def test_a_turn_outside_the_scene_does_no_harm():
    """With the turn and without it every pixel is seen alike, and the line counts as straight."""
    turning = LineView(two_lines(back=False))
    straight = LineView(turning.trajectory.between(None, START + timedelta(seconds=59.4)))
    turning.check(GRID, 50.0)
    heights = np.zeros((1, 1))
    np.testing.assert_allclose(
        turning.look(GRID, WHOLE, heights).vectors, straight.look(GRID, WHOLE, heights).vectors, atol=1e-12
    )
    assert turning.straight(GRID) is not None


def test_a_scene_seen_twice():
    """It is refused until the settings say which line; in itself the nearest pass counts."""
    line = LineView(two_lines())
    with pytest.raises(InputError, match=r"flight.csv passes the scene twice, at 13:30:32 and at 13:31:59; give"):
        line.check(GRID, 50.0)
    wide = Block(0, 0, 96, 800)
    look, east = line.look(GRID, wide, np.zeros((1, 1))), ground_of(wide)[0]
    np.testing.assert_array_equal(look.seconds > 100, east > CENTER[0] + 100)
    first, second = (line.trajectory.between(*times) for times in ((None, at(60)), (at(90), None)))
    LineView(first).check(GRID, 50.0)
    LineView(second).check(GRID, 50.0)
    vectors = LineView(second).look(GRID, WHOLE, np.zeros((1, 1))).vectors
    x = ground_of()[0]
    np.testing.assert_allclose(vectors[0] / vectors[2], (CENTER[0] + 200 - x) / 400, atol=1e-9)


def at(seconds):
    """An instant so many seconds after the start."""
    return START + timedelta(seconds=seconds)


def test_no_samples_in_the_time_asked_for():
    with pytest.raises(InputError, match=r"flight.csv has no sample from .* it has samples from 2024-05-15T13:30:00"):
        two_lines().between(at(5000), None)


def test_pixels_beyond_the_ends_of_a_line_are_unseen():
    """The line ends over the middle of the grid: to half a step beyond it pixels are seen, then no more."""
    y = CENTER[1] + np.arange(-100.0, 0.1, 4.0)
    path = flight(np.arange(y.size), (0 * y + CENTER[0], y, 0 * y + 500), 0.0)
    look = LineView(path).look(GRID, WHOLE, np.zeros((1, 1)))
    north_of_end = ground_of()[1] - CENTER[1]
    np.testing.assert_array_equal(look.unseen, north_of_end > 2.0)
    np.testing.assert_array_equal(look.vectors[:, look.unseen].T, np.tile([0.0, 0.0, 1.0], (look.unseen.sum(), 1)))
    assert np.isfinite(look.vectors).all()
    assert np.isfinite(look.seconds).all()
    with pytest.raises(InputError, match=r"flight.csv does not cover the scene: it passes over 56% of it"):
        LineView(path).check(GRID, 50.0)


def test_a_trajectory_without_heading_that_stands_still(tmp_path):
    path = tmp_path / "flight.csv"
    rows = [f"{at(i).isoformat()},{84600 + 50 * max(i, 2)},447700,500" for i in range(6)]
    path.write_text("\n".join(["utc,x,y,z", *rows]))
    with pytest.raises(InputError, match=r"flight.csv line 2: the sensor stands still.* give the column heading_deg"):
        read_trajectory(path, GRID)


def test_the_sensor_of_a_pixel_is_described():
    path = flight([0, 8], (CENTER[0] + np.zeros(2), CENTER[1] + [-100.0, 100.0], np.full(2, 500.0)), 0.0)
    _, y = GRID.xy(48, 64)
    assert LineView(path).describe(GRID, Block(48, 64, 1, 1), np.zeros((1, 1))) == {
        "seen at": "2024-05-15T13:30:03.990+00:00, 3.990 s after 2024-05-15 13:30:00+00:00",
        "seen from": f"x {CENTER[0]:.2f}, y {y:.2f}, height 500.00 m",
    }
    assert "x 1.00, y 2.00" in FrameView((1.0, 2.0, 3.0)).describe(GRID, WHOLE, np.zeros((1, 1)))["seen from"]
    assert ConstantView(10.0, 20.0).describe(GRID, WHOLE, np.zeros((1, 1))) == {}


# Rasters of angles


def test_rasters_of_angles_and_where_they_are_void():
    """Vectors as they are read; unseen, and upright, where the raster has none."""
    zenith = np.array([[0.0, 30.0, np.nan], [89.0, 91.0, 45.0]])
    azimuth = np.array([[123.0, 90.0, 10.0], [-90.0, 0.0, np.nan]])
    vectors = angle_vectors(zenith, azimuth)
    look = RasterView(held(vectors.copy())).look(GRID, Block(0, 0, 2, 3), np.zeros((1, 1)))
    np.testing.assert_array_equal(look.unseen, [[False, False, True], [False, True, True]])
    np.testing.assert_allclose(look.vectors[:, 0, 1], [0.5, 0, np.sqrt(0.75)], atol=1e-15)
    np.testing.assert_allclose(look.vectors[:, 1, 0], [-np.sin(np.deg2rad(89)), 0, np.cos(np.deg2rad(89))], atol=1e-15)
    np.testing.assert_array_equal(look.vectors[:, 0, 2], [0, 0, 1])


@pytest.mark.parametrize(
    ("zenith", "azimuth", "message"),
    [
        ([0.0, 4512.0], [100.0, 35999.0], r"hold zenith angles from 0 to 4512 .*\(give scale = 0.01\)"),
        ([0.0, 45.0], [100.0, 400.0], "azimuths from 100 to 400; allowed are 0 to 90 and -360 to 360"),
        ([100.0, 200.0], [20.0, 30.0], r"hold zenith angles from 100 to 200 .* wrong way round"),
        ([-5.0, 45.0], [20.0, 30.0], "zenith angles from -5 to 45"),
        ([0.1, 0.7], [-1.0, 3.1], r"radians, by their look\. .* scale = 57.29578"),
        ([np.nan, np.nan], [1.0, 2.0], "a.tif and b.tif hold no angles at all"),
    ],
)
def test_angles_that_are_refused(zenith, azimuth, message):
    with pytest.raises(InputError, match=message):
        check_angles(np.array(zenith), np.array(azimuth), "a.tif and b.tif")


def test_angles_that_are_taken():
    check_angles(np.array([0.0, 90.0, np.nan]), np.array([-180.0, 360.0, 7.0]), "a")
    check_angles(np.array([0.1, 0.7]), np.array([-1.0, 3.1]), "a", sure_of_unit=True)
    check_angles(np.array([0.0, 0.0]), np.array([0.0, 0.0]), "a")


# Orthomosaics


CAMERAS = "id,x,y,z\n7,84700,447700,600\n3,84690,447650,590.5\n"


def test_a_mosaic_from_the_definition(tmp_path):
    """Each pixel looks to its own camera; camera 9 is in no table."""
    path = tmp_path / "cameras.csv"
    path.write_text(CAMERAS)
    cameras = read_cameras(path, height_offset_m=-0.5)
    block, heights = Block(2, 3, 4, 5), heights_of(Block(2, 3, 4, 5))
    ids = np.random.default_rng(1).choice([3, 7, 9, 0, -1, 2**40], (4, 5))
    look = MosaicView(cameras, held(ids)).look(GRID, block, heights)
    x, y = ground_of(block)
    at_place = {7: [84700, 447700, 599.5], 3: [84690, 447650, 590.0]}
    for index in np.ndindex(4, 5):
        place = at_place.get(int(ids[index]))
        assert look.unseen[index] == (place is None)
        expected = np.array([0, 0, 1.0])
        if place is not None:
            expected = np.array(place) - [x[index], y[index], heights[index]]
            expected /= np.linalg.norm(expected)
        np.testing.assert_allclose(look.vectors[:, *index], expected, atol=1e-14)
    view = MosaicView(cameras, held(np.array([[7]])))
    assert view.describe(GRID, Block(0, 0, 1, 1), heights) == {
        "seen from": "camera 7, x 84700.00, y 447700.00, height 599.50 m"
    }
    view.check(GRID, 500.0)
    with pytest.raises(InputError, match=r"camera 3 of .*cameras.csv at height 590.0 m is not above .* at 595.0 m"):
        view.check(GRID, 595.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("id,x,y\n1,2,3\n", "lacks the column z; it has id, x, y"),
        ("id,x,y,z\n", "holds no cameras"),
        (CAMERAS.replace("\n3,", "\n7,"), "id 7 stands there twice"),
        (CAMERAS.replace("\n3,", "\nIMG_3,"), "line 3: id = 'IMG_3'; allowed is a whole number"),
        (CAMERAS.replace("590.5", "high"), "line 3: z = 'high'; allowed is a number"),
    ],
)
def test_camera_tables_that_are_refused(tmp_path, text, message):
    path = tmp_path / "cameras.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=rf"cameras.csv.*{message}"):
        read_cameras(path)


# Conventions and extremes


def test_the_convention_in_a_picture():
    """Sun in the south, camera in the north of a flat roof: phi is 180, whichever way the view is given."""
    to_sun = unit_vector(40.0, 180.0)
    x, y = GRID.xy(48, 64)
    pixel, flat = Block(48, 64, 1, 1), np.zeros((1, 1))
    north = (x, y + 300.0, 400.0)
    eastward = (np.array([x - 500, x + 500]), np.full(2, y + 300.0), np.full(2, 400.0))
    views = {
        "constant": ConstantView(30.0, convergence_deg(GRID, *GRID.center)),
        "frame": FrameView(north),
        "line": LineView(flight([0, 20], eastward, 90.0)),
        "angles": RasterView(held(angle_vectors(np.full((1, 1), 30.0), np.zeros((1, 1))))),
    }
    for name, view in views.items():
        zenith, azimuth = zenith_azimuth(view.look(GRID, pixel, flat).vectors[:, 0, 0])
        assert min(azimuth, 360 - azimuth) < 1e-6, name
        assert zenith == pytest.approx(
            30.0 if name in {"constant", "angles"} else np.rad2deg(np.arctan(0.75)), abs=1e-9
        )
        assert relative_azimuth(azimuth, zenith_azimuth(to_sun)[1]) == pytest.approx(180, abs=1e-6)


@pytest.mark.parametrize("epsg", [28992, 32756, 3413, 3031])
def test_true_north_over_a_grid(epsg):
    """Convergence between the nodes against that of each place: national, southern and polar grids. 20 km."""
    corner = {28992: (84664, 447719), 32756: (334000, 6252000), 3413: (300000, -900000), 3031: (-700000, 500000)}
    x, y = corner[epsg]
    grid = Grid(CRS.from_epsg(epsg), Affine(100, 0, x, 0, -100, y), (200, 200))
    north = north_of(grid)
    rng = np.random.default_rng(2)
    for row, col in rng.integers(0, 200, (25, 2)):
        expected = convergence_deg(grid, *map(float, grid.xy(row, col)))
        found = north.convergence_deg(Block(int(row), int(col), 1, 1))[0, 0]
        assert abs((found - expected + 180) % 360 - 180) < 1e-4
    sine, cosine = north.turn(Block(0, 0, 200, 200))
    np.testing.assert_array_equal(north.turn(Block(7, 9, 30, 4)), [sine[7:37, 9:13], cosine[7:37, 9:13]])


def test_without_a_crs_north_is_up():
    north = north_of(Grid(None, Affine.identity(), (3, 4)))
    np.testing.assert_array_equal(north.convergence_deg(Block(0, 0, 3, 4)), np.zeros((3, 4)))


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1)])
def test_images_of_one_row_or_pixel(shape):
    """Also with the sensor straight above a pixel."""
    grid = Grid(GRID.crs, GRID.transform, shape)
    x, y = (float(value) for value in grid.xy(0, 0))
    path = flight([0, 100], (np.full(2, x), np.array([y - 500, y + 500]), np.full(2, 800.0)), 0.0)
    for view in (FrameView((x, y, 800.0)), LineView(path), ConstantView(0.0, 360.0)):
        view.check(grid, 300.0)
        look = view.look(grid, Block(0, 0, *shape), np.full((1, 1), 300.0))
        np.testing.assert_allclose(look.vectors[:, 0, 0], [0, 0, 1], atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(look.vectors, axis=0), 1, atol=1e-14)


def test_a_camera_in_degrees_is_refused():
    grid = Grid(CRS.from_epsg(28992), Affine(0.5, 0, 84664, 0, -0.5, 447719), (576, 848))
    with pytest.raises(InputError, match="far too low to see it; allowed is a position in the CRS of the image"):
        FrameView((52.0, 4.3, 702.0)).check(grid, 20.0)
    FrameView((84844.0, 447593.0, 702.0)).check(grid, 20.0)
