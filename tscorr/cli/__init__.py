"""The command line: parse, call, print, exit.

Results go to stdout, progress and log to stderr. Exit codes: 0 all done, 1 some scenes failed, 2 bad usage or
configuration, 3 all failed, 130 interrupted, 143 terminated. Heavy modules are imported inside the commands that need
them.
"""

import sys

import click

from tscorr import __version__
from tscorr.cli import model, scenes, start, surfaces
from tscorr.cli.common import without_log_of_rubbish

COMMANDS = (
    start.init,
    start.quicklook,
    scenes.run,
    scenes.plan,
    scenes.explain,
    scenes.verify,
    surfaces.materials,
    surfaces.fit,
    surfaces.width,
    model.bench,
    model.figures,
)


@click.group(name="tscorr", context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="tscorr")
def cli() -> None:
    """Remove the specular peak of man-made surfaces from airborne images of cities."""


for command in COMMANDS:
    cli.add_command(command)


def main() -> None:
    """Entry point of the command `tscorr`."""
    sys.unraisablehook = without_log_of_rubbish
    cli(prog_name="tscorr")
