"""What a report says in plain sentences, from the keys of report.json alone."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

Report = Mapping[str, Any]

GLARE_SHARE = 0.10
"""part of the signal from which on this page calls it glare"""
NOTABLE = 0.005
"""part of a material’s pixels below which nothing is said"""
LATER_MINUTES = 20


class HeadingAdvice(NamedTuple):
    """Headings (each also in the opposite direction) that see the least and the most glare."""

    safest_deg: float
    safest_share: float
    worst_deg: float
    worst_share: float
    worst_material: str


def readable(name: str) -> str:
    """A material's name as words."""
    return name.replace("_", " ")


def count(number: int) -> str:
    """A whole number in groups of three, with narrow spaces that do not break."""
    return f"{number:,}".replace(",", "\u202f")


def percent(fraction: float | None, digits: int = 0) -> str:
    """A fraction as a percentage; a little is never nothing, and most is never all."""
    if fraction is None:
        return "–"
    smallest = 10.0**-digits
    value = 100 * fraction
    if 0 < value < smallest:
        return f"< {smallest:g} %"
    if 100 - smallest < value < 100:
        return f"> {100 - smallest:g} %"
    return f"{value:.{digits}f} %"


def degrees(angle_deg: float | None, digits: int = 0) -> str:
    """An angle with its unit."""
    return "–" if angle_deg is None else f"{angle_deg:.{digits}f}°"


def glare_fraction(material: Report, share: float = GLARE_SHARE) -> float:
    """Part of the material's assessed pixels in which at least this share of the signal is specular."""
    for row in material["specular_share"]["above"]:
        if row["specular_share"] == share:
            return float(row["fraction"] or 0)
    raise KeyError(share)


def by_glare(report: Report) -> list[str]:
    """Names of the materials, the one with the largest part under glare first."""

    def key(name: str) -> tuple[float, int]:
        material = report["materials"][name]
        return glare_fraction(material), material["pixels"]

    return sorted(report["materials"], key=key, reverse=True)


def headline(report: Report) -> str:
    """The first line of the page: how much glare, on what."""
    if report["pixels"]["evaluated"] == 0:
        return "Nothing was assessed in this scene"
    touched = [
        f"{percent(glare_fraction(report['materials'][name]))} of {readable(name)}"
        for name in by_glare(report)
        if glare_fraction(report["materials"][name]) >= NOTABLE
    ]
    return f"Glare touches {listed(touched[:3])}" if touched else "Hardly any glare in this scene"


def standfirst(report: Report) -> list[str]:
    """Sentences that follow the headline: how much, how wide, how it moves, how to avoid it."""
    names = by_glare(report)
    if not names:
        return ["The class map holds none of the materials of the settings."]
    name = max(names, key=lambda name: glare_fraction(report["materials"][name], 0.5))
    sentences = [_strength(report, name), _width(report, name), _motion(report, name), _heading(report)]
    return [sentence for sentence in sentences if sentence]


def listed(items: Sequence[str]) -> str:
    """Items as one speaks them: a, b and c."""
    return " and ".join([", ".join(items[:-1]), items[-1]] if len(items) > 1 else items)


def _strength(report: Report, name: str) -> str:
    """What touched means, and how bad it gets."""
    strong = glare_fraction(report["materials"][name], 0.5)
    sentence = "Touched: at least a tenth of what the camera saw was the sun’s reflection"
    if strong >= NOTABLE:
        sentence += f"; on {percent(strong)} of {readable(name)} it was more than half"
    lost = report["pixels"]["uncorrectable"]
    return sentence + (f". {count(lost)} pixels are beyond correction." if lost else ".")


def _width(report: Report, name: str) -> str:
    zenith = degrees(report["sun"]["zenith_deg"])
    width = report["materials"][name]["level_width_deg"]
    start = f"With the sun {zenith} from the zenith, the glare of level {readable(name)} "
    if width is None:
        return start + "has no azimuthal width: it nowhere falls to half of its strength."
    return start + f"is {degrees(width)} wide in azimuth (full width at half maximum)."


def _motion(report: Report, name: str) -> str:
    drift, width = report["sun"]["drift_deg_per_hour"], report["materials"][name]["level_width_deg"]
    if drift is None:
        return ""
    turned = abs(drift["azimuth"]) * LATER_MINUTES / 60
    part = "" if width is None else f", {percent(turned / width)} of that width"
    return f"{LATER_MINUTES} minutes later the sun has turned it by {degrees(turned)}{part}."


def _heading(report: Report) -> str:
    advice = heading_advice(report)
    if advice is None:
        return ""
    return f"Flight lines heading {both_ways(advice.safest_deg)} would have seen the least of it."


def both_ways(heading_deg: float) -> str:
    """A heading and its opposite, which sees the same."""
    return f"{heading_deg:.0f}° or {heading_deg + 180:.0f}°"


def heading_advice(report: Report) -> HeadingAdvice | None:
    """Where the glare of the worst material is least and most; None where headings were not compared."""
    rows = [row for row in report["heading"] if row["heading_deg"] < 180 and row["max_specular_share"]]
    if not rows:
        return None

    def share(row: Report) -> float:
        return max(row["max_specular_share"].values())

    safest = min(rows, key=lambda row: (share(row), -row["min_facet_tilt_deg"]))
    worst = max(rows, key=lambda row: (share(row), -row["min_facet_tilt_deg"]))
    shares = worst["max_specular_share"]
    return HeadingAdvice(
        safest_deg=safest["heading_deg"],
        safest_share=share(safest),
        worst_deg=worst["heading_deg"],
        worst_share=share(worst),
        worst_material=max(shares, key=shares.__getitem__),
    )
