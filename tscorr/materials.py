"""Materials: Torrance-Sparrow parameters with their source and errors, and the library of the paper."""

import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache
from importlib import resources
from itertools import pairwise
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tscorr.errors import MaterialError, nearest
from tscorr.texts import read_text

Array = NDArray[np.float64]

PARAMETERS = ("t0", "t1", "w", "n", "k")
LONGEST_NAME = 100
FITTED = ("t0", "t1", "w", "n")
"""The order of a covariance matrix: k is held fixed in a fit."""


ALLOWED_WAVELENGTHS = "0.1 to 100 um (550 nm are 0.55 um)"


def is_wavelength(um: Any) -> Any:
    """Whether a number, or each one of an array, can be the wavelength of a band in micrometres."""
    return (um >= 0.1) & (um <= 100)


@dataclass(frozen=True, slots=True)
class Material:
    """One surface: f_r = t0 + t1 f_spec, at one wavelength, at several, or at all.

    t0, t1 [sr^-1], w [1/degree] and the refractive index n - ik are tuples with one value for each of
    `wavelength_um` (ascending), or one value that holds for all of them. `wavelength_um` is empty where the
    source names none. A material of at most one wavelength serves every band; others are interpolated.
    """

    name: str
    t0: tuple[float, ...]
    t1: tuple[float, ...]
    w: tuple[float, ...]
    n: tuple[float, ...]
    k: tuple[float, ...] = (0.0,)
    wavelength_um: tuple[float, ...] = ()
    source: str = ""
    sigma: Mapping[str, float] = field(default_factory=dict)
    """1 sigma of parameters, independent"""
    covariance: tuple[tuple[float, ...], ...] = ()
    """in the order t0, t1, w, n; t0 of the middle wavelength"""
    chi2_dof: float = float("nan")
    zenith_range_deg: tuple[float, float] = (0.0, 90.0)
    """angles of incidence and exitance for which the parameters are meant"""
    file: str = ""
    """where the material was read from; for messages"""

    def __post_init__(self) -> None:
        for name in (*PARAMETERS, "wavelength_um"):
            value = getattr(self, name)
            if isinstance(value, Real):
                object.__setattr__(self, name, (float(value),))
            elif not _is_list(list(value)):
                raise MaterialError(f"material {self._label}: {name} = {value!r}; allowed are numbers")
        check = _Check(self)
        check.wavelengths()
        for name in PARAMETERS:
            check.parameter(name)
        check.ranges()
        check.errors()

    @property
    def has_peak(self) -> bool:
        """Whether the material has a specular part at all."""
        return any(self.t1)

    def at(self, wavelengths_um: Sequence[float] | None = None, bands: int = 1) -> "BandParameters":
        """Parameters for each band: interpolated linearly between the material's own wavelengths.

        wavelengths_um : band centres [um]; may be None where the material has at most one wavelength.
        bands          : number of bands, used where `wavelengths_um` is None.
        Raises MaterialError for a band outside the material's wavelengths, or of unknown wavelength.
        """
        if len(self.wavelength_um) <= 1:
            count = bands if wavelengths_um is None else len(wavelengths_um)
            return BandParameters(*(np.full(count, getattr(self, name)[0]) for name in PARAMETERS))
        if wavelengths_um is None:
            raise MaterialError(
                f"material {self._label} has {len(self.wavelength_um)} wavelengths, but those of the bands "
                f"are unknown: give the scene wavelength_um = [...], one a band"
            )
        wanted = np.asarray(wavelengths_um, dtype=float)
        known = np.asarray(self.wavelength_um)
        rounding = 1e-6  # um: band centres stored as float32
        outside = wanted[~((wanted >= known[0] - rounding) & (wanted <= known[-1] + rounding))]
        if outside.size:
            raise MaterialError(
                f"material {self._label} covers {known[0]:g} to {known[-1]:g} um; the image has a band at "
                f"{outside[0]:g} um"
            )
        return BandParameters(*(_interpolate(wanted, known, np.asarray(getattr(self, name))) for name in PARAMETERS))

    @property
    def _label(self) -> str:
        return f"'{self.name}'" + (f" ({self.file})" if self.file else "")


@dataclass(frozen=True, slots=True)
class BandParameters:
    """Parameters of one material for each band of an image: float64 arrays (bands,)."""

    t0: Array
    t1: Array
    w: Array
    n: Array
    k: Array


def load_materials(path: str | Path) -> dict[str, Material]:
    """Materials of a TOML file, by name; docs/materials.md shows the format.

    Raises MaterialError where the file is missing, is not TOML, or holds a material that cannot be.

    >>> import tscorr
    >>> list(tscorr.load_materials("samples/delft/materials.toml"))[:2]
    ['delft_roof_tile', 'delft_red_concrete']
    """
    path = Path(path)
    return parse_materials(read_text(path, "material library", MaterialError), str(path))


def parse_materials(text: str, file: str) -> dict[str, Material]:
    """Materials of a TOML text; `file` is named in errors."""
    try:
        tables = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise MaterialError(f"{file} is not a TOML file: {error}") from None
    return {name: _material(name, table, file) for name, table in tables.items()}


@cache
def builtin_materials() -> dict[str, Material]:
    """The five surfaces of the paper's table 1 and a Lambertian one."""
    text = resources.files("tscorr").joinpath("data/materials.toml").read_text(encoding="utf-8")
    return {
        name: replace(material, file="built-in")
        for name, material in parse_materials(text, "built-in materials.toml").items()
    }


def find(name: str, library: Mapping[str, Material]) -> Material:
    """The material of that name, or MaterialError naming the nearest one."""
    if not isinstance(name, str):
        raise MaterialError(f"a material is asked for as {name!r}; allowed is the name of one, a text")
    if name not in library:
        known = ", ".join(sorted(library))
        raise MaterialError(f"no material '{name}'{nearest(name, library)}; the libraries hold {known}")
    return library[name]


def material(name: str) -> Material:
    """A material of the built-in library, by name.

    >>> import tscorr
    >>> tscorr.material("roof_tile").w  # 1/degree
    (0.0362,)
    """
    return find(name, builtin_materials())


def _material(name: str, table: Any, file: str) -> Material:
    where = f"{file} [{name}]"
    if not name.isprintable() or not 0 < len(name) <= LONGEST_NAME:
        raise MaterialError(f"{where}; allowed is a name of 1 to {LONGEST_NAME} printable characters")
    if not isinstance(table, dict):
        raise MaterialError(f"{where} is {table!r}; a material is a table")
    known = {f.name for f in fields(Material)} - {"name", "file"}
    for key in table:
        if key not in known:
            raise MaterialError(f"{where} has the unknown key '{key}'{nearest(key, known)}")
    missing = [key for key in FITTED if key not in table]
    if missing:
        raise MaterialError(f"{where} lacks {', '.join(missing)}")
    values: dict[str, Any] = dict(table)
    for key, (is_right, allowed) in TYPES.items():
        if key in values and not is_right(values[key]):
            raise MaterialError(f"{where} {key} = {values[key]!r}; allowed is {allowed}")
    for key in (*PARAMETERS, "wavelength_um"):
        if key in values:
            values[key] = _numbers(values[key], f"{where} {key}")
    for key in ("zenith_range_deg", "covariance"):
        if key in values:
            values[key] = _frozen(values[key])
    return Material(name=name, file=file, **values)


def _numbers(value: Any, where: str) -> tuple[float, ...]:
    """A number or a list of numbers as a tuple."""
    items = value if isinstance(value, list) else [value]
    if not items or not all(map(_is_number, items)):
        raise MaterialError(f"{where} = {value!r}; allowed is a number or a list of numbers")
    return tuple(float(item) for item in items)


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def _is_list(value: Any) -> bool:
    return isinstance(value, list) and all(map(_is_number, value))


def _is_square(value: Any) -> bool:
    return isinstance(value, list) and all(_is_list(row) and len(row) == len(value) for row in value)


TYPES: dict[str, tuple[Callable[[Any], bool], str]] = {
    "source": (lambda value: isinstance(value, str), "a text"),
    "chi2_dof": (_is_number, "a number"),
    "zenith_range_deg": (_is_list, "[low, high]"),
    "sigma": (lambda value: isinstance(value, dict) and _is_list(list(value.values())), "a table of numbers"),
    "covariance": (_is_square, "4 x 4 numbers in the order t0, t1, w, n"),
}
"""what a material file may hold besides numbers and lists of them"""


def _frozen(value: Any) -> Any:
    return tuple(_frozen(item) for item in value) if isinstance(value, list) else value


def _interpolate(wanted: Array, known: Array, values: Array) -> Array:
    return np.full(len(wanted), values[0]) if len(values) == 1 else np.interp(wanted, known, values)


ALLOWED = {
    "t0": (0.0, np.inf, "at least 0"),
    "t1": (0.0, np.inf, "at least 0"),
    "w": (1e-6, 1e3, "from 1e-6 to 1000 per degree"),
    "n": (1e-3, 100.0, "from 0.001 to 100"),
    "k": (0.0, 100.0, "from 0 to 100"),
}


class _Check:
    """What a material must be; each method raises MaterialError with the offending value."""

    def __init__(self, material: Material) -> None:
        self.material = material

    def fail(self, key: str, value: Any, allowed: str) -> None:
        label = self.material._label  # noqa: SLF001 - the material's own checker
        raise MaterialError(f"material {label}: {key} = {value}; allowed is {allowed}")

    def wavelengths(self) -> None:
        wavelengths = self.material.wavelength_um
        if not all(map(is_wavelength, wavelengths)):
            self.fail("wavelength_um", list(wavelengths), ALLOWED_WAVELENGTHS)
        if any(b <= a for a, b in pairwise(wavelengths)):
            self.fail("wavelength_um", list(wavelengths), "an ascending list")

    def parameter(self, name: str) -> None:
        values, count = getattr(self.material, name), max(1, len(self.material.wavelength_um))
        if len(values) not in {1, count}:
            self.fail(name, list(values), f"one value or {count}, one a wavelength")
        low, high, words = ALLOWED[name]
        for value in values:
            if not (low <= value <= high) or not np.isfinite(value):
                self.fail(name, value, words)

    def ranges(self) -> None:
        n, k = self.material.n, self.material.k
        if 1.0 in n and 0.0 in k and self.material.has_peak:
            self.fail("n - ik", "1 - 0i", "any other index: this one reflects nothing")
        zenith = self.material.zenith_range_deg
        if len(zenith) != 2 or not 0 <= zenith[0] < zenith[1] <= 90:
            self.fail("zenith_range_deg", list(zenith), "[low, high] with 0 <= low < high <= 90")

    def errors(self) -> None:
        for key, value in self.material.sigma.items():
            if key not in PARAMETERS:
                self.fail(f"sigma.{key}", value, f"an error of {', '.join(PARAMETERS)}")
            if not (np.isfinite(value) and value >= 0):
                self.fail(f"sigma.{key}", value, "at least 0")
        covariance = self.material.covariance
        if covariance and np.shape(covariance) != (len(FITTED), len(FITTED)):
            self.fail("covariance", "of another shape", "4 x 4 in the order t0, t1, w, n")
