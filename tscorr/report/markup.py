"""Pieces of HTML in the style of the reports: no network, no script; fit for screen, phone and paper."""

import base64
from collections.abc import Iterable, Sequence
from html import escape
from importlib import resources

from tscorr.report.words import percent


def document(title: str, body: str) -> str:
    """A whole document; `title` is escaped, `body` is ready HTML."""
    style = resources.files("tscorr.report").joinpath("page.css").read_text(encoding="utf-8")
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n<main>\n{body}\n</main>\n"
        "</body>\n</html>\n"
    )


def section(title: str, *parts: str) -> str:
    """A section of ready HTML parts; nothing where all of them are empty."""
    body = "\n".join(part for part in parts if part)
    return f"<section>\n<h2>{escape(title)}</h2>\n{body}\n</section>" if body else ""


def paragraph(text: str, kind: str = "") -> str:
    """A paragraph of plain text."""
    return f'<p class="{kind}">{escape(text)}</p>' if kind else f"<p>{escape(text)}</p>"


def image(data: bytes, media_type: str, description: str) -> str:
    """An embedded picture; `description` is for those who do not see it."""
    encoded = base64.b64encode(data).decode("ascii")
    return f'<img src="data:{media_type};base64,{encoded}" alt="{escape(description)}">'


def figure(picture: str, caption: str) -> str:
    """A ready picture under its caption."""
    return f"<figure><figcaption>{escape(caption)}</figcaption>{picture}</figure>"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of plain texts; the first cell of a row is its header. On a phone each row becomes a list."""
    heads = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in head)
    lines = "\n".join(
        f'<tr><th scope="row">{escape(first)}</th>'
        + "".join(
            f'<td data-label="{escape(label)}">{escape(cell)}</td>' for label, cell in zip(head[1:], rest, strict=True)
        )
        + "</tr>"
        for first, *rest in rows
    )
    return f"<table>\n<thead><tr>{heads}</tr></thead>\n<tbody>\n{lines}\n</tbody>\n</table>"


def legend(entries: Iterable[tuple[str, str]]) -> str:
    """What the signs of a drawing mean: pieces of SVG, 26 by 14, and texts."""
    items = "\n".join(
        f'<li><svg width="26" height="14" aria-hidden="true">{sign}</svg>{escape(text)}</li>' for sign, text in entries
    )
    return f'<ul class="legend">\n{items}\n</ul>'


def tile(label: str, value: str, detail: str) -> str:
    """A number that stands out, with what it is and what it means."""
    return (
        f'<div class="tile"><div class="label">{escape(label)}</div>'
        f'<div class="value">{escape(value)}</div><div class="detail">{escape(detail)}</div></div>'
    )


def counts(rows: Iterable[tuple[str, str, float | None, str]]) -> str:
    """A list of counts with a bar each: name, count, fraction of all (None: not known), meaning."""
    items = "\n".join(
        f'<li><span class="name">{escape(name)}</span><span class="number">{escape(number)}</span>'
        f'<span class="number">{escape(percent(fraction, 1))}</span>'
        f'<span class="meaning">{escape(meaning)}</span>'
        f'<span class="bar"><i style="width:{100 * (fraction or 0):.2f}%"></i></span></li>'
        for name, number, fraction, meaning in rows
    )
    return f'<ul class="counts">\n{items}\n</ul>'
