"""Where the sensor is, seen from each pixel: unit vectors surface→sensor, in the axes of the grid.

Positions and pixels are map coordinates, taken as a flat plane. What that neglects, for a sensor 3 km up and 3 km
aside: the Earth's curvature, 0.014 degrees, and the scale of a UTM grid (0.9996 to 1.001), 0.03 degrees at most.
"""

from tscorr.sensor.cameras import Cameras, MosaicView, read_cameras
from tscorr.sensor.layers import RasterView, angle_vectors, check_angles
from tscorr.sensor.line import LineView
from tscorr.sensor.obs import OBS_BANDS, Obs, check_obs, check_obs_slope
from tscorr.sensor.trajectory import Trajectory, read_trajectory
from tscorr.sensor.views import ConstantView, Fan, FrameView, Look, View, ground

__all__ = [
    "OBS_BANDS",
    "Cameras",
    "ConstantView",
    "Fan",
    "FrameView",
    "LineView",
    "Look",
    "MosaicView",
    "Obs",
    "RasterView",
    "Trajectory",
    "View",
    "angle_vectors",
    "check_angles",
    "check_obs",
    "check_obs_slope",
    "ground",
    "read_cameras",
    "read_trajectory",
]
