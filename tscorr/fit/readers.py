"""Files of goniometer measurements: CSV with named columns, and Cornell's text format."""

import csv
import re
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tscorr.errors import InputError, nearest
from tscorr.fit.measurements import Measurements
from tscorr.materials import ALLOWED_WAVELENGTHS, is_wavelength
from tscorr.texts import read_text, separator

Array = NDArray[np.float64]

ANGLES = ("theta_i", "theta_r", "phi")
QUANTITIES = {"f_r": 1.0, "reflectance_factor": 1 / np.pi}
"""factor that makes f_r [sr^-1] of each quantity"""

DEGREES = {"", "deg", "degree", "degrees", "°"}
PER_STERADIAN = {"", "sr^-1", "sr-1", "1/sr"}
UNITS = {
    **dict.fromkeys(ANGLES, DEGREES),
    "f_r": PER_STERADIAN,
    "reflectance_factor": {"", "1"},
    "sigma": PER_STERADIAN | {"1"},
    "wavelength_um": {"", "um", "µm"},
}
"""units that may stand in brackets behind a column's name"""

HEADING = re.compile(r"(?P<name>[^\[\]()]+?)\s*(?:[\[(]\s*(?P<unit>[^\])]*?)\s*[\])])?")
WAVELENGTH_COLUMN = re.compile(r"(?P<name>f_r|reflectance_factor|sigma)_(?P<value>\d+(?:\.\d+)?)(?P<unit>nm|um)")
CORNELL_MIRROR_DEG = 1.0
"""Cornell: the value in the mirror direction of a glossy sample is not to be trusted"""


def read_measurements(path: str | Path) -> Measurements:
    """Measurements of a `.csv` or a Cornell `.brdf` file.

    CSV: a line of column names (`theta_i,theta_r,phi` in degrees; `f_r` in 1/sr or `reflectance_factor`;
    `sigma` in the same unit if known), units in brackets if you like: `theta_i [deg]`. Several wavelengths
    either one a column (`f_r_550nm`, `sigma_550nm`) or one a line, with the column `wavelength_um`.
    Lines that begin with # are passed over; an empty cell is a value that was not measured.
    Raises InputError naming the file and the line.
    """
    path = Path(path)
    readers = {".csv": _read_csv, ".brdf": _read_cornell}
    if path.suffix.lower() not in readers:
        raise InputError(f"{path} is neither .csv nor .brdf; these are the measurements that can be read")
    return readers[path.suffix.lower()](read_text(path, "file of measurements"), str(path))


class _Column(NamedTuple):
    name: str
    wavelength_um: float | None


def _read_csv(text: str, file: str) -> Measurements:
    lines = [
        (number, line)
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if len(lines) < 2:
        raise InputError(f"{file} has {len(lines)} lines; allowed is a line of column names, then values")
    apart = separator(lines[0][1])
    parts = [(number, next(csv.reader([line], delimiter=apart))) for number, line in lines]
    columns = [_column(heading, file) for heading in parts[0][1]]
    quantity = _checked_columns(columns, file)
    rows = [_numbers(cells, len(columns), f"{file} line {number}") for number, cells in parts[1:]]
    return _tabulated(columns, np.array(rows), quantity, file)


def _column(heading: str, file: str) -> _Column:
    match = HEADING.fullmatch(heading.strip().lower())
    name, unit = (match["name"], match["unit"] or "") if match else (heading, "")
    wavelength = WAVELENGTH_COLUMN.fullmatch(name)
    if wavelength:
        name = wavelength["name"]
    if name not in UNITS:
        raise InputError(
            f"{file} has the unknown column '{heading.strip()}'{nearest(name, UNITS)}; columns are "
            f"{', '.join(UNITS)}, and f_r_550nm for one wavelength of several"
        )
    if unit not in UNITS[name]:
        allowed = ", ".join(sorted(UNITS[name] - {""}))
        raise InputError(f"{file}: column {name} is in [{unit}]; allowed is {allowed}")
    if not wavelength:
        return _Column(name, None)
    return _Column(name, float(wavelength["value"]) * (1e-3 if wavelength["unit"] == "nm" else 1.0))


def _checked_columns(columns: list[_Column], file: str) -> str:
    """The quantity that the columns hold; InputError where they do not make a table."""
    if len(set(columns)) != len(columns):
        raise InputError(f"{file} names a column twice: {', '.join(column.name for column in columns)}")
    names = {column.name for column in columns}
    missing = [name for name in ANGLES if name not in names]
    if missing:
        raise InputError(f"{file} lacks the column {', '.join(missing)}; angles are theta_i, theta_r, phi")
    quantities = [name for name in QUANTITIES if name in names]
    if len(quantities) != 1:
        raise InputError(f"{file} has {quantities or 'neither f_r nor reflectance_factor'}; allowed is one")
    values = {column.wavelength_um for column in columns if column.name == quantities[0]}
    sigmas = {column.wavelength_um for column in columns if column.name == "sigma"}
    if sigmas and sigmas != values:
        raise InputError(f"{file} has sigma for some wavelengths only; give all or none")
    if values != {None} and (None in values or "wavelength_um" in names):
        raise InputError(f"{file} has wavelengths both in column names and in lines; allowed is one of them")
    return quantities[0]


def _numbers(cells: list[str], count: int, where: str) -> list[float]:
    if len(cells) != count:
        raise InputError(f"{where} has {len(cells)} cells; the line of names has {count}")
    try:
        return [float(cell) if cell.strip() else float("nan") for cell in cells]
    except ValueError as error:
        raise InputError(f"{where}: {error}; allowed are numbers") from None


def _tabulated(columns: list[_Column], table: Array, quantity: str, file: str) -> Measurements:
    by_column = dict(zip(columns, table.T, strict=True))
    angles = np.stack([by_column[_Column(name, None)] for name in ANGLES])
    in_lines = by_column.get(_Column("wavelength_um", None))
    if in_lines is not None:
        sigma = by_column.get(_Column("sigma", None))
        values = [by_column[_Column(quantity, None)], *([] if sigma is None else [sigma])]
        wavelengths, angles, grids = _by_wavelength(in_lines, angles, values, file)
        f_r, sigma = grids[0], None if sigma is None else grids[1]
    else:
        measured = [column for column in columns if column.name == quantity]
        wavelengths = tuple(value for _, value in measured if value is not None)
        f_r = np.stack([by_column[column] for column in measured])
        errors = [by_column.get(_Column("sigma", value)) for _, value in measured]
        given = [row for row in errors if row is not None]
        sigma = np.stack(given) if given else None
    _check_wavelengths(wavelengths, file)
    factor = QUANTITIES[quantity]
    return Measurements.of(
        angles[0],
        angles[1],
        angles[2],
        factor * f_r,
        None if sigma is None else factor * sigma,
        wavelength_um=wavelengths,
        source=file,
    )


def _by_wavelength(
    wavelength_um: Array, angles: Array, values: list[Array], file: str
) -> tuple[tuple[float, ...], Array, list[Array]]:
    """Lines of one wavelength each as tables (wavelengths, geometries), nan where a line is missing.

    A geometry measured again at the same wavelength becomes a sample of its own.
    """
    if not np.isfinite(wavelength_um).all():
        raise InputError(f"{file}: wavelength_um is empty in a line; every line needs one")
    bands, row = np.unique(wavelength_um, return_inverse=True)
    seen: defaultdict[tuple[float, ...], int] = defaultdict(int)
    samples: dict[tuple[float, ...], int] = {}
    column = np.empty(len(row), dtype=int)
    for line, geometry in enumerate(angles.T.tolist()):
        key = (row[line], *geometry)
        sample = (*geometry, seen[key])
        seen[key] += 1
        column[line] = samples.setdefault(sample, len(samples))
    grids = [np.full((len(bands), len(samples)), np.nan) for _ in values]
    for grid, value in zip(grids, values, strict=True):
        grid[row, column] = value
    geometries = np.array([sample[:3] for sample in samples]).T
    return tuple(bands.tolist()), geometries, grids


def _check_wavelengths(wavelengths: tuple[float, ...], file: str) -> None:
    for value in wavelengths:
        if not is_wavelength(value):
            raise InputError(f"{file}: wavelength {value:g} um; allowed is {ALLOWED_WAVELENGTHS}")


def _read_cornell(text: str, file: str) -> Measurements:
    """Measurements in the format of Cornell's gonioreflectometer.

    The number of wavelengths, the wavelengths [nm], then for each sample theta_i, phi_i, theta_s, phi_s
    [rad] and one f_r [sr^-1] a wavelength; # begins a comment. phi_s - phi_i = pi is forward scattering.
    """
    words = " ".join(line.split("#")[0] for line in text.splitlines()).split()
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError as error:
        raise InputError(f"{file} is not a Cornell .brdf file: {error}") from None
    count = int(numbers[0]) if numbers.size and numbers[0] >= 1 else 0
    body = numbers[1 + count :]
    if not count or not body.size or body.size % (4 + count):
        raise InputError(
            f"{file} is not a whole Cornell .brdf file: {count} wavelengths and {body.size} numbers; allowed "
            f"are {4 + count} numbers a sample"
        )
    samples = body.reshape(-1, 4 + count)
    theta_i, phi_i, theta_s, phi_s = np.rad2deg(samples[:, :4]).T
    wavelengths = tuple((numbers[1 : 1 + count] / 1000).tolist())
    _check_wavelengths(wavelengths, file)
    return Measurements.of(
        theta_i,
        theta_s,
        phi_s - phi_i,
        samples[:, 4:].T,
        wavelength_um=wavelengths,
        source=file,
        mirror_deg=CORNELL_MIRROR_DEG,
    )
