"""Modules import only from lower floors; a folder is one module."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1] / "tscorr"
FLOORS = {
    0: "errors texts angles grid kernels interpreter loops",
    1: "reference materials sun sensor",
    2: "terrain width fit correction config eye",
    3: "rasters publish report stac bench quicklook",
    4: "scene",
    5: "batch",
    6: "api cli",
    7: "__init__ __main__",
}
FLOOR = {name: floor for floor, names in FLOORS.items() for name in names.split()}
FOR_ALL = {"errors", "__version__"}
"""the error tree and the version carry no code, and stand below the house"""
MAPS = {"rasterio", "affine"}
MAPS_ALLOWED = {"grid", "rasters", "scene"}
FILES = sorted(ROOT.rglob("*.py"))


def module_of(path):
    """Name of the module in the table: the first part of the path under the package."""
    return path.relative_to(ROOT).parts[0].removesuffix(".py")


def imported(path):
    """Dotted names that a file imports at run time, inside functions too; not those under TYPE_CHECKING."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    blocks = (
        node for node in ast.walk(tree) if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
    )
    typing_only = {node for block in blocks for node in ast.walk(block)}
    for node in ast.walk(tree):
        if node in typing_only:
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name} line {node.lineno}: imports are absolute"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_come_from_lower_floors(path):
    mine = module_of(path)
    for name in imported(path):
        package, *inner = name.split(".")
        if package == "tscorr" and inner[0] not in FOR_ALL | {mine}:
            theirs = inner[0] if inner[0] in FLOOR else "__init__"
            assert FLOOR[theirs] < FLOOR[mine], f"{mine} imports {name}"
        if package in MAPS:
            assert mine in MAPS_ALLOWED, f"{mine} imports {name}"


def test_every_module_has_a_floor():
    assert {module_of(path) for path in FILES} <= set(FLOOR)
