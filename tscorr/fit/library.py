"""Materials as a TOML file that `tscorr.materials.load_materials` reads: what a fit leaves behind."""

import math
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Protocol

import tomli_w

from tscorr.errors import InputError, MaterialError, OutputError
from tscorr.materials import PARAMETERS, Material, load_materials

HEAD = "# Torrance-Sparrow parameters: t0, t1 in 1/sr, w in 1/degree; the covariance is that of t0, t1, w, n\n"


def materials_toml(materials: Iterable[Material]) -> str:
    """The text of a material library."""
    return HEAD + "\n" + tomli_w.dumps({material.name: _table(material) for material in materials})


def save_materials(materials: Iterable[Material], path: str | Path) -> None:
    """Write a material library, whole or not at all."""
    path = Path(path)
    hidden = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        hidden.write_text(materials_toml(materials), encoding="utf-8")
        hidden.replace(path)
    except OSError as error:
        hidden.unlink(missing_ok=True)
        raise OutputError(f"the materials {path} cannot be written: {error}") from None


def check_replaceable(path: str | Path | None, names: Iterable[str]) -> None:
    """Raise InputError where a file exists that holds anything but materials of these names, which would be lost."""
    if path is None or not Path(path).exists():
        return
    try:
        others = sorted(set(load_materials(path)) - set(names))
    except MaterialError as error:
        raise InputError(f"the file {path} exists and is no library of materials ({error}); name another") from None
    if others:
        raise InputError(
            f"the library {path} holds {', '.join(others)}, which would be lost; allowed is a file of its own: "
            f"[materials] library takes several"
        )


class Fitted(Protocol):
    """A fit of a material, whatever it was fitted to."""

    @property
    def material(self) -> Material:
        """What was found."""

    @property
    def converged(self) -> bool:
        """Whether it may be used."""


def save_converged(results: Mapping[str, Fitted], path: str | Path | None) -> tuple[str, ...]:
    """Write the materials whose fits converged, if there is a path to write to; the names of the others."""
    usable = [result.material for result in results.values() if result.converged]
    if path is not None and usable:
        save_materials(usable, path)
    return tuple(name for name, result in results.items() if not result.converged)


def _table(material: Material) -> dict[str, Any]:
    """Only what the material says: one value as a number, several as a list."""
    table: dict[str, Any] = {
        "source": material.source,
        "wavelength_um": _plain(material.wavelength_um),
        **{name: _plain(getattr(material, name)) for name in PARAMETERS},
        "sigma": dict(material.sigma),
        "covariance": [list(row) for row in material.covariance],
        "zenith_range_deg": list(material.zenith_range_deg),
    }
    if not math.isnan(material.chi2_dof):
        table["chi2_dof"] = material.chi2_dof
    return {key: value for key, value in table.items() if value not in ("", [], {})}


def _plain(values: tuple[float, ...]) -> float | list[float]:
    return values[0] if len(values) == 1 else list(values)
