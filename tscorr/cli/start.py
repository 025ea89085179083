"""Commands to start with an image: init, quicklook."""

import os
from pathlib import Path
from typing import Literal

import click

from tscorr.cli.common import with_clear_errors
from tscorr.errors import ConfigError, OutputError

image_argument = click.Path(exists=True, dir_okay=False, path_type=Path)


@click.command()
@click.argument("image", type=image_argument, required=False)
@click.option("-o", "--output", type=click.Path(dir_okay=False, path_type=Path), help="Default: named as the image.")
@click.option("--class-map", type=image_argument, help="Default: class_map.tif beside the image.")
@click.option("--schema", is_flag=True, help="Print the JSON Schema of configurations instead, for editors.")
@with_clear_errors
def init(image: Path | None, output: Path | None, class_map: Path | None, schema: bool) -> None:
    """Write a configuration for IMAGE, with a comment on every key; three values are left to fill in."""
    import json

    from tscorr import config

    if schema:
        click.echo(json.dumps(config.json_schema(), indent=1))
        return
    if image is None:
        raise ConfigError("IMAGE is missing; allowed is a raster, or --schema")
    output = Path(f"{image.stem}.toml") if output is None else output
    class_map = image.with_name("class_map.tif") if class_map is None else class_map
    text = config.template(_as_in(output, image), _as_in(output, class_map), image.stem, _facts(image))
    try:
        with output.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise OutputError(f"{output} exists and is not overwritten; name another by -o") from None
    except OSError as error:
        raise OutputError(f"{output} cannot be written: {error}") from None
    click.echo(f"{output}: fill in the values that read {config.FILL_IN}, then: tscorr plan {output}")


def _as_in(config: Path, path: Path) -> str:
    """A path as it stands in a configuration: relative to the file's folder where there is a way."""
    try:
        return Path(os.path.relpath(path.absolute(), config.absolute().parent)).as_posix()
    except ValueError:  # on another drive
        return path.absolute().as_posix()


def _facts(image: Path) -> list[str]:
    """What the header of an image says, as lines of text."""
    from tscorr import rasters

    info = rasters.describe(image)
    rows, cols = info.shape
    centres = "unknown" if info.wavelengths_um is None else ", ".join(f"{um:g}" for um in info.wavelengths_um)
    crs = "no CRS" if info.grid.crs is None else info.grid.crs.to_string().split("[")[0]
    return [
        f"Of {image.name}: {rows} rows, {cols} columns, {info.bands} bands of {info.dtype}; {crs};",
        f"scale {info.scales[0]:g}, offset {info.offsets[0]:g}, nodata {info.nodata}; wavelengths [um]: {centres}",
    ]


@click.command()
@click.argument("image", type=image_argument)
@click.option(
    "-o",
    "--output",
    required=True,
    type=click.Path(dir_okay=False, path_type=Path),
    help=".png, or .exr: linear light.",
)
@click.option(
    "--exposure", type=click.FloatRange(0, min_open=True), help="Factor; default: bright parts near white, 1 for .exr."
)
@click.option("--false-colour", is_flag=True, help="Near-infrared, red and green as red, green and blue.")
@click.option(
    "--size", type=click.IntRange(16, 20000), default=2048, show_default=True, help="Longest side in pixels."
)
@with_clear_errors
def quicklook(image: Path, output: Path, exposure: float | None, false_colour: bool, size: int) -> None:
    """Draw IMAGE in true colour; bands that no eye sees are left out."""
    from tscorr.scene.pictures import draw_image

    style: Literal["true_colour", "false_colour"] = "false_colour" if false_colour else "true_colour"
    note = draw_image(image, output, exposure=exposure, style=style, max_px=size)
    click.echo(f"{output}: {note}")
