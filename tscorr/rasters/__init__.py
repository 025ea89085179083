"""Rasters on disk: open and check, align on the fly, read a block, write a block.

GDAL never applies scale and offset; neither does anything here: blocks hold stored values.
"""

from tscorr.rasters.decimated import LEAST_STEP, Means, decimated, read_decimated, read_decimated_flags
from tscorr.rasters.difference import expressible, write_difference
from tscorr.rasters.envi_writing import ENVI_SUFFIX, EnviWriter
from tscorr.rasters.header import (
    IMAGE_TYPES,
    RasterInfo,
    can_hold,
    check_metric,
    check_overlap,
    check_true_lengths,
    covered_share,
    describe,
    environment,
    opened,
)
from tscorr.rasters.joining import join_rows, result
from tscorr.rasters.kept import KeptReader
from tscorr.rasters.reading import Reader, middle_value, read_samples
from tscorr.rasters.stored_tiles import StoredTiles
from tscorr.rasters.writing import Layer, Writer, make_cog, unwatched

__all__ = [
    "ENVI_SUFFIX",
    "IMAGE_TYPES",
    "LEAST_STEP",
    "EnviWriter",
    "KeptReader",
    "Layer",
    "Means",
    "RasterInfo",
    "Reader",
    "StoredTiles",
    "Writer",
    "can_hold",
    "check_metric",
    "check_overlap",
    "check_true_lengths",
    "covered_share",
    "decimated",
    "describe",
    "environment",
    "expressible",
    "join_rows",
    "make_cog",
    "middle_value",
    "opened",
    "read_decimated",
    "read_decimated_flags",
    "read_samples",
    "result",
    "unwatched",
    "write_difference",
]
