"""The configuration: a TOML file as pydantic models, checked before any work starts."""

from tscorr.config.loading import absolute, load_config, paths_of, with_run_settings
from tscorr.config.scenes import (
    AnglesViewSettings,
    ConstantViewSettings,
    DsmSettings,
    FlatSettings,
    FrameViewSettings,
    LineViewSettings,
    MosaicViewSettings,
    NormalsSettings,
    ObsSurfaceSettings,
    ObsViewSettings,
    Scene,
    Sun,
    Truth,
)
from tscorr.config.sections import Config, Correction, MaterialSettings, Model
from tscorr.config.template import FILL_IN, json_schema, template

__all__ = [
    "FILL_IN",
    "AnglesViewSettings",
    "Config",
    "ConstantViewSettings",
    "Correction",
    "DsmSettings",
    "FlatSettings",
    "FrameViewSettings",
    "LineViewSettings",
    "MaterialSettings",
    "Model",
    "MosaicViewSettings",
    "NormalsSettings",
    "ObsSurfaceSettings",
    "ObsViewSettings",
    "Scene",
    "Sun",
    "Truth",
    "absolute",
    "json_schema",
    "load_config",
    "paths_of",
    "template",
    "with_run_settings",
]
