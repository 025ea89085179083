"""Where the sensor is: worked pixels of the Delft flights, hand-made headings and pitches, trajectories refused."""

import json
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from affine import Affine
from rasterio.crs import CRS

from tscorr.angles import angle_between, unit_vector, zenith_azimuth
from tscorr.errors import InputError
from tscorr.grid import Block, Grid
from tscorr.sensor import ConstantView, FrameView, LineView, read_trajectory

DELFT = Path(__file__).parents[1] / "samples/delft"
TRUTH = json.loads((DELFT / "truth/angles.json").read_text())
CAMERAS = json.loads((DELFT / "cameras.json").read_text())
CONVERGENCE = TRUTH["grid_convergence_deg"]
GRID = Grid(CRS.from_epsg(28992), Affine(0.5, 0, 84664, 0, -0.5, 447719), (576, 848))
WHOLE = Block(0, 0, *GRID.shape)
START = datetime.fromisoformat("2024-05-15T13:30:00Z")


def frame(name):
    camera = CAMERAS["frames"][name]
    return FrameView((camera["x"], camera["y"], camera["z"]))


def view(name):
    return LineView(read_trajectory(DELFT / "trajectory.csv", GRID)) if name == "line" else frame(name)


@pytest.mark.parametrize("name", ["forward", "nadir", "line"])
def test_worked_pixels_of_the_delft_flights(name):
    """View angles that the makers of the scene give; the trajectory's heading is that of the scene's centre."""
    seen_by = view(name)
    for pixel in TRUTH["sample_pixels"][name]:
        block = Block(pixel["row"], pixel["col"], 1, 1)
        vector = seen_by.vectors(GRID, block, np.array([[pixel["z"]]]))[:, 0, 0]
        truth = unit_vector(pixel["view_zenith_deg"], pixel["view_azimuth_grid_deg"])
        assert angle_between(vector, truth) < (1e-3 if name == "line" else 1e-7)


def test_a_constant_view_is_turned_to_the_grid():
    vector = ConstantView(20.0, 350.0).vectors(GRID, WHOLE, np.zeros((1, 1)))
    assert vector.shape == (3, 1, 1)
    np.testing.assert_allclose(vector[:, 0, 0], unit_vector(20.0, 350.0 - CONVERGENCE), atol=1e-5)
    ConstantView(20.0, 350.0).check(GRID, 1e9)
    local = Grid(None, GRID.transform, GRID.shape)
    np.testing.assert_allclose(ConstantView(20.0, 90.0).vectors(local, WHOLE, 0)[:, 0, 0], unit_vector(20, 90))


def test_a_frame_from_the_definition():
    block, heights = Block(3, 5, 4, 6), np.random.default_rng(1).uniform(0, 30, (4, 6))
    vectors = frame("forward").vectors(GRID, block, heights)
    for row, col in np.ndindex(4, 6):
        ground = np.array([84664 + 0.5 * (5 + col + 0.5), 447719 - 0.5 * (3 + row + 0.5), heights[row, col]])
        to_camera = np.array(frame("forward").position) - ground
        np.testing.assert_allclose(vectors[:, row, col], to_camera / np.linalg.norm(to_camera), rtol=1e-13)


def test_under_the_camera_the_view_is_upright():
    x, y = GRID.xy(100, 200)
    zenith, _ = zenith_azimuth(FrameView((x, y, 500.0)).vectors(GRID, Block(100, 200, 1, 1), np.zeros((1, 1))))
    assert zenith == 0


@pytest.mark.parametrize(("highest", "refused"), [(604.9, False), (605.0, True), (700.0, True), (float("nan"), True)])
def test_a_camera_below_the_surface_is_refused(highest, refused):
    if not refused:
        frame("forward").check(GRID, highest)
        return
    with pytest.raises(InputError, match=r"camera at height 605.0 m is not above the surface, whose highest point"):
        frame("forward").check(GRID, highest)


def write_trajectory(folder, x, y, z, **attitude):
    """A CSV with a sample a second; x, y, z and attitude broadcast."""
    names = ["utc", "x", "y", "z", *attitude]
    columns = np.broadcast_arrays(x, y, z, *attitude.values())
    lines = [
        ",".join([(START + timedelta(seconds=second)).isoformat(), *map(repr, map(float, values))])
        for second, values in enumerate(zip(*columns, strict=True))
    ]
    path = folder / "flight.csv"
    path.write_text("\n".join([",".join(names), *lines]) + "\n")
    return path


def eastward(folder, **attitude):
    """A flight line along a row of the grid, 1000 m up, 50 m/s to grid east."""
    x = 84000 + 50.0 * np.arange(40)
    return LineView(read_trajectory(write_trajectory(folder, x, 447575.0, 1000.0, **attitude), GRID))


def sensor_of(vectors, block, heights, height=1000.0):
    """Map coordinates of the sensor: along the view vector up to its height."""
    rows, cols = np.mgrid[block.slices]
    x, y = GRID.xy(rows, cols)
    distance = (height - heights) / vectors[2]
    return x + distance * vectors[0], y + distance * vectors[1]


BLOCK = Block(280, 400, 5, 7)
EAST_TRUE = 90 + CONVERGENCE
"""azimuth from true north of the grid's east"""


@pytest.mark.parametrize("attitude", [{}, {"roll_deg": 12.0, "pitch_deg": 0.0, "heading_deg": EAST_TRUE}])
def test_without_attitude_the_sensor_is_abeam(tmp_path, attitude):
    """Heading along the track and no pitch are the same as no attitude; roll changes no vector."""
    heights = np.random.default_rng(2).uniform(0, 50, BLOCK.shape)
    x, y = sensor_of(eastward(tmp_path, **attitude).vectors(GRID, BLOCK, heights), BLOCK, heights)
    np.testing.assert_allclose(x, GRID.xy(*np.mgrid[BLOCK.slices])[0], atol=0.01)
    np.testing.assert_allclose(y, 447575.0, atol=1e-6)


def test_a_scene_is_seen_from_when_its_first_column_is_abeam_to_when_its_last_is(tmp_path):
    line = eastward(tmp_path)
    rows, cols = GRID.shape
    x, _ = GRID.xy(np.array([0, (rows - 1) / 2, 0]), np.array([0, (cols - 1) / 2, cols - 1]))
    seconds = np.interp(x, line.trajectory.table[0], line.trajectory.seconds)
    np.testing.assert_allclose(line.span(GRID, 20.0), seconds, atol=1e-3)


def test_nose_up_looks_ahead(tmp_path):
    """Pitch 5 at 1000 m: a pixel is seen from (1000 - z) tan 5 before the point abeam."""
    line = eastward(tmp_path, roll_deg=0.0, pitch_deg=5.0, heading_deg=EAST_TRUE)
    heights = np.full(BLOCK.shape, 20.0)
    x, _ = sensor_of(line.vectors(GRID, BLOCK, heights), BLOCK, heights)
    ahead = GRID.xy(*np.mgrid[BLOCK.slices])[0] - x
    np.testing.assert_allclose(ahead, 980 * np.tan(np.deg2rad(5)), atol=0.02)


def test_heading_turns_the_scan_plane(tmp_path):
    """Flying east with the nose 10 degrees to the south: north of the track the scan line runs ahead."""
    line = eastward(tmp_path, roll_deg=0.0, pitch_deg=0.0, heading_deg=EAST_TRUE + 10)
    block, heights = Block(0, 400, 3, 3), np.zeros((3, 3))
    x, _ = sensor_of(line.vectors(GRID, block, heights), block, heights)
    ground_x, ground_y = GRID.xy(*np.mgrid[block.slices])
    np.testing.assert_allclose(ground_x - x, (ground_y - 447575) * np.tan(np.deg2rad(10)), atol=0.02)


def test_a_winding_flight_from_the_definition(tmp_path):
    """(ground - position) . forward = 0 at the time found, with position and forward linear between samples."""
    rng = np.random.default_rng(3)
    count = 60
    x = 84600 + 10.0 * np.arange(count)
    y = 447575 + 3 * np.sin(np.arange(count) / 6)
    z = 800 + rng.normal(0, 0.5, count)
    heading = 90 + CONVERGENCE + np.cumsum(rng.normal(0, 0.2, count))
    path = write_trajectory(
        tmp_path, x, y, z, roll_deg=rng.normal(0, 3, count), pitch_deg=rng.normal(0, 0.2, count), heading_deg=heading
    )
    line = LineView(read_trajectory(path, GRID))
    ground = GRID.xy(*np.mgrid[BLOCK.slices])
    heights = rng.uniform(0, 20, BLOCK.shape)
    seconds = line.look(GRID, BLOCK, heights).seconds
    position, forward = line.trajectory.at(seconds)
    to_sensor = position - np.stack([*ground, heights])
    assert np.abs((to_sensor * forward).sum(axis=0)).max() < 1e-3
    for index in np.ndindex(BLOCK.shape):
        np.testing.assert_allclose(position[0][index], np.interp(seconds[index], np.arange(count), x))
    np.testing.assert_allclose(line.vectors(GRID, BLOCK, heights), to_sensor / np.linalg.norm(to_sensor, axis=0))


def test_heights_and_crs_of_a_trajectory(tmp_path):
    """Ellipsoidal heights and another CRS: both are brought to the grid's."""
    path = write_trajectory(tmp_path, 4.36 + 0.001 * np.arange(5), 52.0, 1043.2)
    trajectory = read_trajectory(path, GRID, lambda x, y: (x * 1e4, y * 1e4), height_offset_m=-43.2)
    np.testing.assert_allclose(trajectory.x, 1e4 * (4.36 + 0.001 * np.arange(5)))
    np.testing.assert_allclose(trajectory.y, 520000)
    np.testing.assert_allclose(trajectory.z, 1000.0)
    assert trajectory.start == START


def test_which_flights_are_straight(tmp_path):
    start, end = eastward(tmp_path).straight(GRID)
    np.testing.assert_allclose([start[1:], end[1:]], [[447575, 1000]] * 2)
    assert start[0] < 84664
    assert end[0] > 84664 + 0.5 * 848
    assert view("line").straight(GRID) is not None
    assert eastward(tmp_path, roll_deg=0.0, pitch_deg=1.0, heading_deg=EAST_TRUE).straight(GRID) is None
    x = 84000 + 50.0 * np.arange(40)
    bent = write_trajectory(tmp_path, x, 447575 + 1e-2 * np.arange(40) ** 2, 1000.0)
    assert LineView(read_trajectory(bent, GRID)).straight(GRID) is None


def test_a_flight_must_pass_the_scene_above_it(tmp_path):
    eastward(tmp_path).check(GRID, 50.0)
    with pytest.raises(InputError, match=r"flight.csv goes down to 1000.0 m; the highest point .* is at 1200.0 m"):
        eastward(tmp_path).check(GRID, 1200.0)
    for first in (84900, 83800):  # begins in the scene's second half; ends in its first
        part = LineView(read_trajectory(write_trajectory(tmp_path, first + 50.0 * np.arange(20), 447575, 900), GRID))
        with pytest.raises(InputError, match=r"flight.csv does not cover the scene"):
            part.check(GRID, 50.0)


GOOD = "utc,x,y,z\n2024-05-15T13:30:00Z,1,2,3\n2024-05-15T13:30:01Z,50,2,3\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "cannot be read"),
        ("\xff", "lacks the column utc"),
        ("", "lacks the column utc"),
        (GOOD.replace(",z", ",height"), "lacks the column z; it has utc, x, y, height"),
        (GOOD.replace("30:01Z", "30:00Z"), "utc must hold at least two ascending times"),
        (GOOD[:37], "utc must hold at least two ascending times"),
        ("utc,x,y,z\n", "utc must hold at least two ascending times"),
        (GOOD.replace("30:01Z", "30:01"), "line 3: utc = '2024-05-15T13:30:01' names no time zone; append Z"),
        (GOOD.replace("2024-05-15T13:30:01Z", "noon"), "line 3: utc = 'noon'; allowed is ISO 8601"),
        (GOOD.replace("50,2", "fifty,2"), "line 3: x = 'fifty'; allowed is a number"),
        (GOOD.replace("50,2", "nan,2"), "line 3: x = 'nan'; allowed is a number"),
        (GOOD.replace("50,2,3", "50,2"), "line 3: z = None; allowed is a number"),
        (GOOD.replace("50,2", "1.5,2"), "1 m"),
    ],
)
def test_trajectories_that_are_refused(tmp_path, text, message):
    path = tmp_path / "flight.csv"
    if text is not None:
        path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=rf"flight.csv.*{message}"):
        read_trajectory(path, GRID)


def test_semicolons_and_capitals_are_read(tmp_path):
    path = tmp_path / "flight.csv"
    path.write_text(GOOD, "utf-8")
    plain = read_trajectory(path, GRID)
    path.write_text(GOOD.replace(",", ";").replace("utc;x;y;z", "UTC;X;Y;Z"), "utf-8")
    np.testing.assert_array_equal(read_trajectory(path, GRID).table, plain.table)


def test_a_spreadsheets_csv_is_read(tmp_path):
    """With a byte-order mark, spaces in the header and columns in another order."""
    path = tmp_path / "flight.csv"
    path.write_text("\ufeff z , utc,y,x\n3,2024-05-15T15:30:00+02:00,2,1\n3,2024-05-15T13:30:02Z,2,50\n", "utf-8")
    trajectory = read_trajectory(path, GRID)
    np.testing.assert_allclose(trajectory.seconds, [0, 2])
    np.testing.assert_allclose([trajectory.x[1], trajectory.y[1], trajectory.z[1]], [50, 2, 3])
    np.testing.assert_allclose(trajectory.forward, [[1, 1], [0, 0], [0, 0]], atol=1e-15)
