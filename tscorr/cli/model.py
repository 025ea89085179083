"""Commands about the model itself: bench, figures."""

import sys
from pathlib import Path

import click

from tscorr.cli.common import PICTURES, can_be_written, with_clear_errors
from tscorr.errors import OutputError


@click.command()
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

    can_be_written("--json", json_file)
    can_be_written("--plot", plot, PICTURES)
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


@click.command()
@click.argument("folder", type=click.Path(file_okay=False, path_type=Path))
@with_clear_errors
def figures(folder: Path) -> None:
    """Draw figures 1 to 5 of the paper, from the model alone, into FOLDER."""
    from tscorr.bench import draw_figures

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"the folder {folder} cannot be made: {error.strerror}") from None
    for path in draw_figures(folder):
        click.echo(path)
