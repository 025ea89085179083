"""A result of `bench` as a table and as a picture."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tscorr.errors import OutputError

HEAD = ("", "variant", "ns/px", "ns/px/band", "max rel.", "RMS rel.", "max abs. R", "error/bound")


ERROR = "max_absolute_reflectance_error"
"""the error that is held against the run time"""


def on_the_front(entries: Sequence[dict[str, Any]]) -> list[bool]:
    """Whether no other variant of the same kind and form is both faster and closer to the truth."""

    def beaten(entry: dict[str, Any]) -> bool:
        return any(
            other["ns_per_pixel"] < entry["ns_per_pixel"] and other[ERROR] < entry[ERROR]
            for other in entries
            if _form(other) == _form(entry) and _images(other) == _images(entry)
        )

    return [not beaten(entry) for entry in entries]


def table(result: dict[str, Any]) -> str:
    """Run times and errors, the front of Pareto starred; the worst inputs; what leaving out G does."""
    entries = result["variants"]
    rows = [HEAD]
    for entry, front in zip(entries, on_the_front(entries), strict=True):
        numbers = (f"{entry['ns_per_pixel']:.1f}", f"{entry['ns_per_pixel_and_band']:.1f}")
        errors = (
            f"{entry[key]:.1e}"
            for key in ("max_relative_error", "rms_relative_error", "max_absolute_reflectance_error")
        )
        rows.append(("*" if front else "", entry["name"], *numbers, *errors, f"{entry['error_over_bound']:.2f}"))
    lines = _columns(rows)
    lines += [
        "",
        "* no other variant of its kind and form is both faster and closer. Errors of the reflectance removed,",
        "  relative ones above 1e-6 and the threshold, absolute ones up to a reflectance of 1; found by search.",
        "",
        "Stored in steps of 1e-4, against exact:",
    ]
    lines += [
        f"  {entry['name']}: at most {stored['most_steps']} step, {stored['differing']:.1e} of {stored['values']} "
        f"values differ, {stored['flags']:.1e} of the flags"
        for entry in entries
        if (stored := entry.get("stored"))
    ]
    lines += ["", "Worst inputs (error / bound is largest):"]
    lines += [line for entry in entries for line in _worst(entry)]
    lines += ["", "Largest relative difference of the simplified form [%], by limit of both zenith angles:"]
    return "\n".join(lines + _forms(result["simplified_form"]))


def plot(result: dict[str, Any], path: str | Path) -> None:
    """Largest absolute error against run time, both logarithmic; the fronts of Pareto as lines."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    entries = result["variants"]
    front = on_the_front(entries)
    for number, form in enumerate(("full", "simplified")):
        of_form = [(e, f) for e, f in zip(entries, front, strict=True) if _form(e) == form]
        best = sorted((e["ns_per_pixel"], e[ERROR]) for e, f in of_form if f and _images(e))
        axes.plot(*zip(*best, strict=True), color=f"C{number}", linewidth=1, alpha=0.6)
        for entry, _ in of_form:
            x, y = entry["ns_per_pixel"], entry[ERROR]
            axes.plot(x, y, marker="o" if _images(entry) else "^", color=f"C{number}")
            left = number == 1 and _images(entry)
            axes.annotate(
                entry["name"],
                (x, y),
                textcoords="offset points",
                xytext=(-6 if left else 6, -11 if number == 1 else 5),
                ha="right" if left else "left",
                fontsize=8,
                color=f"C{number}",
            )
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="processor time [ns per pixel; ● image of 4 bands, ▲ lobe from angles]",
        ylabel="largest error of the reflectance removed, up to a reflectance of 1",
        title="Run time against error",
    )
    axes.grid(visible=True, which="major", alpha=0.3)
    axes.margins(x=0.18, y=0.08)
    try:
        figure.savefig(path, dpi=120)
    except OSError as error:
        raise OutputError(f"the plot {path} cannot be written: {error}") from None


def _form(entry: dict[str, Any]) -> str:
    return "simplified" if "simplified" in entry["name"] else "full"


def _images(entry: dict[str, Any]) -> bool:
    """Whether the variant corrects images; else it evaluates a lobe."""
    return not entry["name"].startswith("angles")


def _worst(entry: dict[str, Any]) -> list[str]:
    worst = entry["worst_input"]
    parameters = ", ".join(f"{key} {value:g}" for key, value in worst["material"].items() if key != "name")
    angles = ", ".join(f"{key[:-4]} {worst[key]!r}" for key in worst if key.endswith("_deg"))
    share = f"{entry['error_over_bound']:.2f} of {entry['bound']}"
    return [
        f"  {entry['name']}: {worst['error']:.3g} of {worst['removed']:.6g}, {share}",
        f"    {worst['material']['name']} ({parameters})",
        f"    {angles}",
    ]


def _forms(rows: Sequence[dict[str, Any]]) -> list[str]:
    limits = sorted({row["max_zenith_deg"] for row in rows})
    found = {
        (row["material"], row["relative_azimuth_deg"], row["max_zenith_deg"]): row["max_relative_difference"]
        for row in rows
    }
    lines = [("", "material, phi", *(f"<= {limit}" for limit in limits))]
    for name, azimuth in dict.fromkeys((key[0], key[1]) for key in found):
        numbers = (f"{100 * found[name, azimuth, limit]:.3g}" for limit in limits)
        lines.append(("", f"{name}, {azimuth}", *numbers))
    return _columns(lines)


def _columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Columns side by side, the first two to the left, numbers to the right."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return [
        "  ".join(
            cell.ljust(width) if i < 2 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
