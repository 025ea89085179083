"""Directions to try: everywhere, and densely where arithmetic goes wrong."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


class Directions(NamedTuple):
    """Source, viewer and facet by angles, arrays of one shape. [deg]"""

    incidence: Array
    exitance: Array
    relative_azimuth: Array
    """these three from the facet's normal; 180 is forward scatter"""
    turn: Array
    """azimuth of the source about the facet's normal, from the direction the facet leans to"""
    slope: Array
    aspect: Array
    """how much, and to where, the facet leans; aspect from east to north"""

    def vectors(self) -> tuple[Array, Array, Array]:
        """Unit vectors (3, ...) to source and viewer, and of the normal; east, north, up; float64."""
        up = np.zeros_like(self.slope)
        return (
            self._leaning(_unit(self.incidence, self.turn)),
            self._leaning(_unit(self.exitance, self.turn + self.relative_azimuth)),
            self._leaning(np.stack([up, up, up + 1])),
        )

    def _leaning(self, vector: Array) -> Array:
        """A vector about an upright facet as it is about the facet that leans."""
        slope, aspect = np.deg2rad(self.slope), np.deg2rad(self.aspect)
        x, y, z = vector
        along, up = np.cos(slope) * x + np.sin(slope) * z, np.cos(slope) * z - np.sin(slope) * x
        return np.stack([np.cos(aspect) * along - np.sin(aspect) * y, np.sin(aspect) * along + np.cos(aspect) * y, up])

    def take(self, places: Array) -> "Directions":
        """Some of them."""
        return Directions(*(angle[places] for angle in self))

    @classmethod
    def join(cls, *parts: "Directions") -> "Directions":
        """All of several."""
        return cls(*(np.concatenate(angles) for angles in zip(*parts, strict=True)))


def hard_directions(rng: np.random.Generator, count: int, max_zenith_deg: float) -> Directions:
    """`count` directions of each kind: anywhere; at the peak and in the lobe; grazing; along the normal;
    back-scatter; in the principal plane and across it; where G becomes 1; forward and grazing.

    Distances from the special place are spread evenly over powers of ten, from 1e-8 to 10 degrees.
    """

    def anywhere() -> Array:
        return rng.uniform(0, max_zenith_deg, count)

    def away() -> Array:
        return 10 ** rng.uniform(-8, 1, count)

    def either_side() -> Array:
        return away() * rng.choice([-1, 1], count)

    azimuth = rng.uniform(0, 180, count)
    i = anywhere()
    places = [
        (anywhere(), anywhere(), azimuth),
        (i, i + either_side(), 180 - away()),
        (i, i + rng.normal(0, 10, count), 180 - np.abs(rng.normal(0, 20, count))),
        (max_zenith_deg - away(), anywhere(), azimuth),
        (anywhere(), max_zenith_deg - away(), azimuth),
        (max_zenith_deg - away(), max_zenith_deg - away(), 180 - away()),
        (away(), anywhere(), azimuth),
        (away(), away(), azimuth),
        (i, i + either_side(), away()),
        (anywhere(), anywhere(), rng.choice([0.0, 90.0, 180.0], count)),
        (i, (180 + i) / 3 + either_side(), 180 - away()),
        (i, (180 - i) / 3 + either_side(), away()),
    ]
    total = count * len(places)
    incidence, exitance, phi = (np.concatenate(angles) for angles in zip(*places, strict=True))
    level = rng.random(total) < 0.25
    return clipped(
        Directions(
            incidence,
            exitance,
            phi,
            rng.uniform(0, 360, total),
            np.where(level, 0, rng.uniform(0, 60, total)),
            rng.uniform(0, 360, total),
        ),
        max_zenith_deg,
    )


def clipped(directions: Directions, max_zenith_deg: float) -> Directions:
    """The nearest directions that are allowed."""
    incidence, exitance, phi, turn, slope, aspect = directions
    return Directions(
        np.clip(incidence, 0, max_zenith_deg),
        np.clip(exitance, 0, max_zenith_deg),
        np.clip(phi, 0, 180),
        turn,
        np.clip(slope, 0, 60),
        aspect,
    )


def _unit(zenith_deg: Array, azimuth_deg: Array) -> Array:
    zenith, azimuth = np.deg2rad(zenith_deg), np.deg2rad(azimuth_deg)
    return np.stack(
        [np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.sin(np.deg2rad(90 - zenith_deg))]
    )
