"""Commands about materials: materials, fit, width."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from tscorr.cli.common import (
    PICTURES,
    can_be_written,
    form_option,
    library_option,
    number,
    print_table,
    with_clear_errors,
)
from tscorr.cli.scenes import progress_bars
from tscorr.errors import ConfigError, InputError

if TYPE_CHECKING:
    from tscorr.fit.files import FittedFiles
    from tscorr.scene.samples import FittedScenes


@click.command()
@click.option("--library", multiple=True, type=click.Path(exists=True, path_type=Path), help="Another TOML file.")
@with_clear_errors
def materials(library: Sequence[Path]) -> None:
    """List the materials of the built-in library, and of others."""
    from tscorr.materials import builtin_materials, load_materials

    known = dict(builtin_materials())
    for path in library:
        known.update(load_materials(path))
    rows: list[tuple[str, ...]] = [("name", "source", "wavelengths", "t0", "t1", "w", "n", "k")]
    for name, entry in known.items():
        values = (f"{getattr(entry, key)[0]:g}" for key in ("t0", "t1", "w", "n", "k"))
        bands = f"{len(entry.wavelength_um)}" if entry.wavelength_um else "any"
        rows.append((name, entry.source[:48], bands, *values))
    print_table(rows)
    click.echo("t0, t1 in 1/sr, w in 1/degree, at the first wavelength")


@click.command()
@click.argument("files", nargs=-1, type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option(
    "--scenes",
    "config",
    metavar="CONFIG",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="Fit to the images of a configuration instead, seen in different directions.",
)
@click.option("-o", "--output", type=click.Path(dir_okay=False, path_type=Path), help="Material file to write.")
@click.option("--name", help="Name of the material; several files are then of this one surface.")
@click.option("--k", default="0.25", show_default=True, help="Held at this value, or 'free'.")
@click.option("--wavelengths", metavar="UM,UM...", help="Only these, in um.")
@form_option
@click.option("--bootstrap", type=click.IntRange(0), default=0, metavar="N", help="Replicates that check the errors.")
@click.option("--plot", type=click.Path(file_okay=False, path_type=Path), help="Folder for plots of the fit.")
@with_clear_errors
def fit(
    files: Sequence[Path],
    config: Path | None,
    output: Path | None,
    name: str | None,
    k: str,
    wavelengths: str | None,
    form: Literal["full", "simplified"],
    bootstrap: int,
    plot: Path | None,
) -> None:
    """Fit materials to goniometer FILES (.csv, .brdf), or to the scenes of a configuration."""
    if (config is None) == (not files):
        raise ConfigError("give files of measurements, or --scenes CONFIG" + (", not both" if files else ""))
    can_be_written("-o", output)
    held = None if k == "free" else number("--k", k, "a number or 'free'")
    fitted: FittedFiles | FittedScenes
    if config is None:
        from tscorr.fit import FitSettings, fit_files

        settings = FitSettings(k=held, form=form, bootstrap=bootstrap)
        only = None if wavelengths is None else [number("--wavelengths", um, "um,um") for um in wavelengths.split(",")]
        fitted = fit_files(files, output, name=name, wavelengths_um=only, settings=settings, plot_directory=plot)
    else:
        given = {"--name": name, "--wavelengths": wavelengths, "--bootstrap": bootstrap, "--plot": plot}
        for option in (option for option, value in given.items() if value):
            raise ConfigError(f"{option} is for files of measurements; leave it out with --scenes")
        fitted = _fit_to_scenes(config, output, held, form)
    click.echo(fitted.text)
    if output is not None and len(fitted.unfinished) < len(fitted.results):
        click.echo(f"materials: {output}")
    if fitted.unfinished:
        names = ", ".join(fitted.unfinished)
        raise InputError(f"fits that did not converge, and of which no material is written: {names}")


def _fit_to_scenes(
    config: Path, output: Path | None, k: float | None, form: Literal["full", "simplified"]
) -> "FittedScenes":
    """Fit the materials of a configuration to its scenes."""
    from tscorr import batch
    from tscorr.config import load_config
    from tscorr.fit.scenes import SceneFitSettings
    from tscorr.scene.samples import fit_scenes

    if k is None:
        raise ConfigError("--k free is for files of measurements: images do not tell n, t1 and k apart")
    with progress_bars(enabled=sys.stderr.isatty()) as progress:
        return fit_scenes(batch.plan(load_config(config)), output, SceneFitSettings(k=k, form=form), progress)


@click.command()
@click.argument("names", nargs=-1, required=True, metavar="MATERIAL...")
@library_option
@form_option
@click.option("--wavelength", type=float, metavar="UM", help="Default: the middle one of each material.")
@click.option("--plot", type=click.Path(dir_okay=False, path_type=Path), help="Picture to write: .png, .svg or .pdf.")
@with_clear_errors
def width(
    names: Sequence[str], libraries: Sequence[Path], form: str, wavelength: float | None, plot: Path | None
) -> None:
    """Show how wide the specular peak of each MATERIAL is, against the angle of incidence."""
    from tscorr.materials import builtin_materials, find, load_materials
    from tscorr.width import crossover_incidence, width_rows

    can_be_written("--plot", plot, PICTURES)
    known = dict(builtin_materials())
    for path in libraries:
        known.update(load_materials(path))
    surfaces = [find(name, known) for name in names]
    rows: list[tuple[str, ...]] = [("material", "incidence", "azimuthal", "arc", "zenithal", "peak exitance")]
    notes = []
    for surface in surfaces:
        if not surface.has_peak:
            notes.append(f"{surface.name} has no peak")
            continue
        for row in width_rows(surface, form=form, wavelength_um=wavelength):
            incidence, *widths = row.values()
            rows.append((surface.name, f"{incidence:.0f}", *("-" if v is None else f"{v:.1f}" for v in widths)))
        crossover = crossover_incidence(surface, form, wavelength_um=wavelength)
        notes.append(
            f"{surface.name}: from {crossover:.1f} degrees of incidence on, its exponential is narrower in azimuth "
            f"than in the principal plane"
        )
    print_table(rows, left=1)
    click.echo("degrees; azimuthal width and arc: full width at half maximum of the lobe at exitance = incidence;")
    click.echo("zenithal width: of the exponential, cut at the horizon; -: no half maximum, or no peak before it")
    for note in notes:
        click.echo(note)
    if plot is not None:
        from tscorr.width.plot import save_width_plot

        save_width_plot(surfaces, plot, form)
        click.echo(f"plot: {plot}")
