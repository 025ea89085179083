"""Commands about the scenes of a configuration: run, plan, explain, verify."""

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tscorr.cli.common import compilation_told, config_argument, percent, print_table, with_clear_errors
from tscorr.errors import ConfigError, TscorrError

if TYPE_CHECKING:
    from tscorr.batch import BatchResult, SceneProgress


@click.command()
@config_argument
@click.option("--scene", "scenes", multiple=True, metavar="NAME", help="Only this scene; may be repeated.")
@click.option("--material", "materials", multiple=True, metavar="NAME", help="Correct only this material.")
@click.option("--workers", type=click.IntRange(0, 256), help="Threads; 0 for as many as there are cores, up to 4.")
@click.option("--scheduler", metavar="ADDRESS", help="Of a Dask cluster that does the work: tcp://host:port.")
@click.option("--overwrite", is_flag=True, help="Recompute scenes whose result is current.")
@click.option("-q", "--quiet", is_flag=True, help="No progress and no table.")
@with_clear_errors
def run(
    config: Path,
    scenes: Sequence[str],
    materials: Sequence[str],
    workers: int | None,
    scheduler: str | None,
    overwrite: bool,
    quiet: bool,
) -> None:
    """Correct the scenes of CONFIG; scenes whose result is current are left as they are."""
    from tscorr import batch

    with compilation_told(enabled=not quiet), progress_bars(enabled=not quiet and sys.stderr.isatty()) as progress:
        result = batch.run(
            config,
            scenes=scenes,
            materials=materials,
            workers=workers,
            scheduler=scheduler,
            overwrite=overwrite,
            progress=progress,
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

    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TextColumn("{task.percentage:>3.0f} %"))
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
        report = scene.report
        if report is None:
            notes.append(f"{scene.name}: failed: {scene.error}")
            continue
        for name, entry in report["materials"].items():
            share = entry["specular_share"]
            if entry["corrected"] + entry["uncorrectable"] > 0:
                counts = f"{entry['corrected']:,}", f"{entry['uncorrectable']:,}"
                rows.append((scene.name, name, *counts, percent(share["p95"]), percent(share["max"])))
        if (residual := report.get("residual_glare")) is not None:
            notes.append(
                f"{scene.name}: residual glare {residual['rms_before']:.4f} before, {residual['rms_after']:.4f} after "
                f"(RMS of reflectance against the truth)"
                + (f": {residual['ratio']:.3f} of it is left" if residual["ratio"] is not None else "")
            )
        notes += [f"{scene.name}: {doubt}" for doubt in doubts(report)]
        if bad := report.get("bad_bands"):
            notes.append(f"{scene.name}: {left_alone(bad)}")
        if scene.state == "current":
            notes.append(f"{scene.name}: nothing to do, the result is current")
    print_table(rows)
    for note in notes:
        click.echo(note)
    here = Path.cwd()
    folder = result.folder.relative_to(here) if result.folder.is_relative_to(here) else result.folder
    click.echo(f"results: {folder}")


WHY_NOT = ("nodata", "self_shadow", "cast_shadow", "not_viewed", "grazing")
"""flags that keep the pixels of a material from being assessed"""


def doubts(report: dict[str, Any]) -> list[str]:
    """What can hardly be meant, from the pixel counts of a report."""
    found, pixels = [], report["pixels"]
    unseen = [name for name, entry in report["materials"].items() if 0 < entry["pixels"] == entry["not_assessed"]]
    if unseen:
        flags = ", ".join(f"{pixels[key]:,} are {key.upper()}" for key in WHY_NOT if pixels[key])
        found.append(
            f"no pixel of {', '.join(unseen)} was assessed; of the scene's {pixels['total']:,} pixels {flags}"
        )
    if 0 < pixels["valid"] == pixels["no_material"]:
        found.append("nothing was assessed: no class of [materials.classes] occurs where the image has data")
    if 0 < pixels["valid"] == pixels["saturated"]:
        found.append("every pixel is saturated: is `saturation` in stored values?")
    return found


def left_alone(bad: Sequence[str]) -> str:
    """What is said of bands that the image marks as bad."""
    listed = ", ".join(bad) if len(bad) <= 4 else f"{', '.join(bad[:3])}, ..."
    return f"{len(bad)} bad {'band' if len(bad) == 1 else 'bands'} left as in the image: {listed}"


@click.command()
@config_argument
@click.option("--json", "as_json", is_flag=True, help="Machine-readable.")
@with_clear_errors
def plan(config: Path, as_json: bool) -> None:
    """Check every input of CONFIG and say what would be computed and what skipped; writes nothing."""
    import json

    from tscorr import batch
    from tscorr.config import load_config
    from tscorr.scene.forecast import forecast

    forecasts = [forecast(scene) for scene in batch.plan(load_config(config), to_run=True)]
    if as_json:
        click.echo(json.dumps({"scenes": forecasts}, indent=1))
        return
    for entry in forecasts:
        click.echo(f"{entry['scene']}: {entry['image']}, {entry['rows']} x {entry['cols']} x {entry['bands']}")
        click.echo(f"  sun zenith {entry['sun']['zenith_deg']:.2f}, azimuth {entry['sun']['azimuth_deg']:.2f} degrees")
        low, middle, high = entry["view_zenith_deg"] or (float("nan"),) * 3
        click.echo(f"  view zenith {low:.1f} to {high:.1f}, median {middle:.1f} degrees")
        low, middle, high = entry["relative_azimuth_deg"] or (float("nan"),) * 3
        click.echo(f"  relative azimuth {low:.0f} to {high:.0f}, median {middle:.0f} degrees; the glare is at 180")
        shadows = "cast shadows are looked for" if entry["shadows"] else "no cast shadows"
        click.echo(f"  surface {entry['surface']}, {shadows}")
        for name, share in entry["materials"].items():
            click.echo(f"  {name}: {100 * share:.1f} % of the pixels")
        if entry["bad_bands"]:
            click.echo(f"  {left_alone(entry['bad_bands'])}")
        click.echo(f"  no material: {100 * entry['no_material']:.1f} % of the pixels{_listed(entry)}")
        skipped = f"{entry['blocks_no_specular_material']} of {entry['blocks']} blocks have nothing to correct"
        click.echo(
            f"  {skipped}; at most {entry['disk_mb']:.0f} MB on disk, about {entry['memory_mb']:.0f} MB of memory"
        )
        for row in entry["negligible"]:
            click.echo(
                f"  negligible_reflectance = {row['negligible_reflectance']:.2g}{' (in use)' if row['set'] else ''}: "
                f"nothing to remove in about {100 * row['pixels']:.1f} % of the pixels, {100 * row['blocks']:.0f} % "
                f"of the blocks"
            )
        click.echo(f"  {'current: nothing to do' if entry['current'] else 'to be computed'}")


MOST_CLASSES = 6


def _listed(entry: dict[str, Any]) -> str:
    """The most frequent classes that have no material, as the end of a line."""
    shares = list(entry["classes_without_material"].items())
    names = [f"class {name}" if name.lstrip("-").isdigit() else name for name, _ in shares]
    listed = [f"{name}: {100 * share:.1f} %" for name, (_, share) in zip(names, shares, strict=True)][:MOST_CLASSES]
    more = [f"{len(shares) - MOST_CLASSES} more"] if len(shares) > MOST_CLASSES else []
    return f" ({', '.join(listed + more)})" if listed else ""


@click.command()
@config_argument
@click.option("--scene", metavar="NAME", help="Which, if the configuration has several.")
@click.option("--pixel", required=True, type=(int, int), metavar="ROW COL", help="From 0, row before column.")
@with_clear_errors
def explain(config: Path, scene: str | None, pixel: tuple[int, int]) -> None:
    """Show everything known of one pixel: vectors, angles, F, G, lobe, removed, flags."""
    from tscorr import batch
    from tscorr.config import load_config
    from tscorr.scene.explain import explanation

    settings = load_config(config)
    names = [str(entry.name) for entry in settings.scenes]
    if scene is None and len(names) > 1:
        raise ConfigError(f"give --scene: {config} has {', '.join(names)}")
    (planned,) = batch.plan(settings, [scene or names[0]])
    for title, lines in explanation(planned, *pixel).items():
        click.echo(title)
        for name, value in lines.items():
            click.echo(f"  {name:<24} {value}")


@click.command()
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@with_clear_errors
def verify(folder: Path) -> None:
    """Hash the published results under FOLDER again and compare them with their manifests."""
    from tscorr import publish

    results = publish.published(folder)
    if not results:
        raise TscorrError(f"{folder} holds no {publish.MANIFEST}: nothing was published there")
    problems = [problem for result in results for problem in publish.damaged(result)]
    for problem in problems:
        click.echo(problem)
    click.echo(f"{len(results)} results, {len(problems)} problems")
    if problems:
        click.echo("tscorr run --overwrite computes results again", err=True)
    sys.exit(1 if problems else 0)
