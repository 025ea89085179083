"""The model in plain numpy, to be read beside the paper, and the correction of a block that uses it as it stands."""

from tscorr.reference.block import correct_block
from tscorr.reference.equations import (
    DirectionVariance,
    Geometry,
    Gradient,
    attenuation,
    brdf,
    brdf_gradient,
    broadened,
    direction_variance,
    facet_distribution,
    fresnel,
    fresnel_gradient,
    geometry,
    geometry_from_angles,
    log_gradient,
    specular,
)

__all__ = [
    "DirectionVariance",
    "Geometry",
    "Gradient",
    "attenuation",
    "brdf",
    "brdf_gradient",
    "broadened",
    "correct_block",
    "direction_variance",
    "facet_distribution",
    "fresnel",
    "fresnel_gradient",
    "geometry",
    "geometry_from_angles",
    "log_gradient",
    "specular",
]
