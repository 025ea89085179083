"""The command line: parse, call, print, exit.

Results go to stdout, progress and log to stderr. Exit codes: 0 all done, 1 some scenes failed, 2 bad usage or
configuration, 3 all failed, 130 interrupted. Heavy modules are imported inside the commands that need them.
"""

import functools
import logging
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from tscorr import __version__
from tscorr.errors import ConfigError, TscorrError

if TYPE_CHECKING:
    from tscorr.batch import BatchResult, SceneProgress

BAD_USAGE, INTERRUPTED = 2, 130


def with_clear_errors(command: Callable[..., Any]) -> Callable[..., Any]:
    """A command whose errors are one message on stderr and an exit code."""

    @functools.wraps(command)
    def wrapped(*args: Any, **kwargs: Any) -> Any:
        console = logging.StreamHandler(sys.stderr)
        console.setLevel(logging.WARNING)
        logging.basicConfig(format="tscorr: %(message)s", handlers=[console])
        try:
            return command(*args, **kwargs)
        except TscorrError as error:
            for line in str(error).splitlines():
                click.echo(f"tscorr: {line}", err=True)
            sys.exit(BAD_USAGE)
        except KeyboardInterrupt:
            click.echo("tscorr: interrupted; what was finished stays, the rest is done by the next run", err=True)
            sys.exit(INTERRUPTED)

    return wrapped


@click.group(name="tscorr", context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="tscorr")
def cli() -> None:
    """Remove the specular peak of man-made surfaces from airborne images of cities."""


config_argument = click.argument("config", type=click.Path(exists=True, dir_okay=False, path_type=Path))


@cli.command()
@config_argument
@click.option("--scene", "scenes", multiple=True, metavar="NAME", help="Only this scene; may be repeated.")
@click.option("--material", "materials", multiple=True, metavar="NAME", help="Correct only this material.")
@click.option("--workers", type=click.IntRange(0, 256), help="Threads; 0 for all cores.")
@click.option("--overwrite", is_flag=True, help="Recompute scenes whose result is current.")
@click.option("-q", "--quiet", is_flag=True, help="No progress and no table.")
@with_clear_errors
def run(
    config: Path, scenes: Sequence[str], materials: Sequence[str], workers: int | None, overwrite: bool, quiet: bool
) -> None:
    """Correct the scenes of CONFIG; scenes whose result is current are left as they are."""
    from tscorr import batch

    with progress_bars(enabled=not quiet and sys.stderr.isatty()) as progress:
        result = batch.run(
            config, scenes=scenes, materials=materials, workers=workers, overwrite=overwrite, progress=progress
        )
    if not quiet:
        print_outcome(result)
    sys.exit(result.exit_code)


@contextmanager
def progress_bars(*, enabled: bool) -> Iterator["SceneProgress"]:
    """A progress bar for each scene on a terminal, nothing elsewhere."""
    from tscorr.batch import silent_scene

    if not enabled:
        yield silent_scene
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:>3.0f} %"))
    with Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True)) as bars:

        def start(scene: Any) -> Callable[[int], None]:
            rows, cols = scene.image.shape
            task = bars.add_task(scene.name, total=rows * cols)
            return lambda pixels: bars.advance(task, pixels)

        yield start


def print_outcome(result: "BatchResult") -> None:
    """For each scene and material with a peak: pixels corrected, largest share; and the residual where known."""
    rows = [("scene", "material", "corrected", "uncorrectable", "share p95", "share max")]
    notes = []
    for scene in result.scenes:
        if scene.report is None:
            notes.append(f"{scene.name}: failed: {scene.error}")
            continue
        for name, entry in scene.report["materials"].items():
            share = entry["specular_share"]
            if entry["corrected"] + entry["uncorrectable"] > 0:
                counts = f"{entry['corrected']:,}", f"{entry['uncorrectable']:,}"
                rows.append((scene.name, name, *counts, percent(share["p95"]), percent(share["max"])))
        if (residual := scene.report.get("residual_glare")) is not None:
            notes.append(
                f"{scene.name}: residual glare {residual['rms_before']:.4f} before, {residual['rms_after']:.4f} after "
                f"(RMS of reflectance against the truth)"
                + (f": {residual['ratio']:.3f} of it is left" if residual["ratio"] is not None else "")
            )
        if scene.state == "current":
            notes.append(f"{scene.name}: nothing to do, the result is current")
    print_table(rows)
    for note in notes:
        click.echo(note)
    here = Path.cwd()
    folder = result.folder.relative_to(here) if result.folder.is_relative_to(here) else result.folder
    click.echo(f"results: {folder}")


def percent(share: float | None) -> str:
    """A share as text."""
    if share is None:
        return "-"
    return f"{100 * share:.1f} %"


def print_table(rows: Sequence[Sequence[str]], left: int = 2) -> None:
    """Columns side by side, the first `left` to the left, numbers to the right."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    for row in rows:
        cells = [
            cell.ljust(width) if i < left else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        click.echo("  ".join(cells).rstrip())


@cli.command()
@config_argument
@click.option("--json", "as_json", is_flag=True, help="Machine-readable.")
@with_clear_errors
def plan(config: Path, as_json: bool) -> None:
    """Check every input of CONFIG and say what would be computed and what skipped; writes nothing."""
    import json

    from tscorr import batch
    from tscorr.config import load_config
    from tscorr.scene.forecast import forecast

    forecasts = [forecast(scene) for scene in batch.plan(load_config(config))]
    if as_json:
        click.echo(json.dumps({"scenes": forecasts}, indent=1))
        return
    for entry in forecasts:
        click.echo(f"{entry['scene']}: {entry['image']}, {entry['rows']} x {entry['cols']} x {entry['bands']}")
        click.echo(f"  sun zenith {entry['sun']['zenith_deg']:.2f}, azimuth {entry['sun']['azimuth_deg']:.2f} degrees")
        low, middle, high = entry["view_zenith_deg"] or (float("nan"),) * 3
        click.echo(f"  view zenith {low:.1f} to {high:.1f}, median {middle:.1f} degrees")
        for name, share in entry["materials"].items():
            click.echo(f"  {name}: {100 * share:.1f} % of the pixels")
        click.echo(f"  no material: {100 * entry['no_material']:.1f} % of the pixels")
        skipped = f"{entry['blocks_no_specular_material']} of {entry['blocks']} blocks have nothing to correct"
        click.echo(
            f"  {skipped}; at most {entry['disk_mb']:.0f} MB on disk, about {entry['memory_mb']:.0f} MB of memory"
        )
        click.echo(f"  {'current: nothing to do' if entry['current'] else 'to be computed'}")


@cli.command()
@config_argument
@click.option("--scene", required=True, metavar="NAME")
@click.option("--pixel", required=True, type=(int, int), metavar="ROW COL", help="From 0, row before column.")
@with_clear_errors
def explain(config: Path, scene: str, pixel: tuple[int, int]) -> None:
    """Show everything known of one pixel: vectors, angles, F, G, lobe, removed, flags."""
    from tscorr import batch
    from tscorr.config import load_config
    from tscorr.scene.explain import explanation

    (planned,) = batch.plan(load_config(config), [scene])
    for title, lines in explanation(planned, *pixel).items():
        click.echo(title)
        for name, value in lines.items():
            click.echo(f"  {name:<24} {value}")


@cli.command()
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


form_option = click.option(
    "--form", type=click.Choice(["full", "simplified"]), default="full", help="simplified: without the factor G."
)
library_option = click.option(
    "--library",
    "libraries",
    multiple=True,
    metavar="FILE",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="Another material file.",
)


@cli.command()
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
    held = None if k == "free" else _number("--k", k, "a number or 'free'")
    if config is None:
        from tscorr.fit import FitSettings, fit_files

        settings = FitSettings(k=held, form=form, bootstrap=bootstrap)
        only = (
            None if wavelengths is None else [_number("--wavelengths", um, "um,um") for um in wavelengths.split(",")]
        )
        fitted = fit_files(files, output, name=name, wavelengths_um=only, settings=settings, plot_directory=plot)
        click.echo(fitted.text)
    else:
        given = {"--name": name, "--wavelengths": wavelengths, "--bootstrap": bootstrap, "--plot": plot}
        for option in (option for option, value in given.items() if value):
            raise ConfigError(f"{option} is for files of measurements; leave it out with --scenes")
        click.echo(_fit_to_scenes(config, output, held, form))
    if output is not None:
        click.echo(f"materials: {output}")


def _fit_to_scenes(config: Path, output: Path | None, k: float | None, form: Literal["full", "simplified"]) -> str:
    """Fit the materials of a configuration to its scenes; the result as text."""
    from tscorr import batch
    from tscorr.config import load_config
    from tscorr.fit.scenes import SceneFitSettings
    from tscorr.scene.samples import fit_scenes

    if k is None:
        raise ConfigError("--k free is for files of measurements: images do not tell n, t1 and k apart")
    with progress_bars(enabled=sys.stderr.isatty()) as progress:
        return fit_scenes(batch.plan(load_config(config)), output, SceneFitSettings(k=k, form=form), progress).text


def _number(option: str, text: str, allowed: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ConfigError(f"{option} = {text!r}; allowed is {allowed}") from None


@cli.command()
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


@cli.command()
@click.option("--json", "json_file", type=click.Path(dir_okay=False, path_type=Path), help="Write the numbers here.")
@click.option("--plot", type=click.Path(dir_okay=False, path_type=Path), help="Draw error against run time here.")
@click.option("--quick", is_flag=True, help="A shorter search: looser, but still one.")
@with_clear_errors
def bench(json_file: Path | None, plot: Path | None, quick: bool) -> None:
    """Run time against error of every way to evaluate the lobe, on this machine.

    Errors are searched for; one beyond what is promised ends with exit code 1.
    """
    import json

    from tscorr import bench

    result = bench.bench(quick=quick)
    click.echo(bench.table(result))
    if json_file is not None:
        json_file.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    if plot is not None:
        bench.plot(result, plot)
    broken = bench.broken_promises(result)
    for promise in broken:
        click.echo(f"tscorr: {promise}", err=True)
    sys.exit(1 if broken else 0)


@cli.command()
@click.argument("folder", type=click.Path(file_okay=False, path_type=Path))
@with_clear_errors
def figures(folder: Path) -> None:
    """Draw figures 1 to 5 of the paper, from the model alone, into FOLDER."""
    from tscorr.bench import draw_figures

    folder.mkdir(parents=True, exist_ok=True)
    for path in draw_figures(folder):
        click.echo(path)


@cli.command()
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@with_clear_errors
def verify(folder: Path) -> None:
    """Hash the published results under FOLDER again and compare them with their manifests."""
    from tscorr import publish

    manifests = sorted(folder.glob(f"**/{publish.MANIFEST}"))
    if not manifests:
        raise TscorrError(f"{folder} holds no {publish.MANIFEST}: nothing was published there")
    problems = [problem for path in manifests for problem in publish.damaged(path.parent)]
    for problem in problems:
        click.echo(problem)
    click.echo(f"{len(manifests)} results, {len(problems)} problems")
    sys.exit(1 if problems else 0)


def main() -> None:
    """Entry point of the command `tscorr`."""
    cli(prog_name="tscorr")
