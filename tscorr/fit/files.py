"""Files in, a material library, plots and a summary out: what `tscorr fit` does."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from tscorr.errors import InputError
from tscorr.fit.fitting import FitSettings, fit_measurements
from tscorr.fit.library import check_replaceable, save_converged
from tscorr.fit.measurements import Measurements, merge
from tscorr.fit.readers import read_measurements
from tscorr.fit.result import FitResult


class FittedFiles(NamedTuple):
    """Results by material name, and the same as text."""

    results: dict[str, FitResult]
    text: str
    unfinished: tuple[str, ...]
    """materials whose fits did not converge, which are not written"""


def fit_files(
    paths: Sequence[str | Path],
    output: str | Path | None = None,
    *,
    name: str | None = None,
    wavelengths_um: Sequence[float] | None = None,
    settings: FitSettings | None = None,
    plot_directory: str | Path | None = None,
) -> FittedFiles:
    """Fit the measurements of files: one material a file, named by its stem.

    paths          : `.csv` or Cornell `.brdf`
    output         : material file to write, ready for `[materials] library`; not one that holds other materials
    name           : the material's name; several files are then measurements of this one surface
    wavelengths_um : only these; each must have been measured
    plot_directory : where to draw curves and residuals

    A material whose fit did not converge is not written. Raises InputError naming the file where one cannot be read
    or fitted; then nothing is written.
    """
    if output is not None and Path(output).resolve() in {Path(path).resolve() for path in paths}:
        raise InputError(f"the material file {output} is one of the files of measurements; allowed is another name")
    settings = settings or FitSettings()
    by_material = _by_material(paths, name)
    check_replaceable(output, by_material)
    results = {
        key: fit_measurements(measured if wavelengths_um is None else measured.at(wavelengths_um), settings, key)
        for key, measured in by_material.items()
    }
    unfinished = save_converged(results, output)
    if plot_directory is not None:
        from tscorr.fit.plots import save_plots

        for result in results.values():
            save_plots(result, plot_directory)
    return FittedFiles(results, "\n\n".join(result.summary() for result in results.values()), unfinished)


def _by_material(paths: Sequence[str | Path], name: str | None) -> dict[str, Measurements]:
    files = [Path(path) for path in paths]
    if not files:
        raise InputError("no file of measurements is named")
    if name is not None:
        return {name: merge([read_measurements(file) for file in files])}
    measured: dict[str, Measurements] = {}
    for file in files:
        if file.stem in measured:
            raise InputError(f"{file} and {measured[file.stem].source} would both be material '{file.stem}'")
        measured[file.stem] = read_measurements(file)
    return measured
