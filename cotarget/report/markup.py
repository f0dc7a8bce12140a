"""Pieces of HTML; every text is escaped here and nowhere else."""

import base64
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape

from cotarget.report.tables import Table


@dataclass(frozen=True)
class Picture:
    """A picture for the page and for the folder beside it.

    Attributes:
        name: of its file, without ending.
        png: the picture.
        svg: the same, where that is what the page shows.
        alt: what it shows, for those who do not see it.
        caption: how to read it.
    """

    name: str
    png: bytes
    svg: bytes | None
    alt: str
    caption: str


def paragraph(text: str, kind: str = "") -> str:
    """Write a paragraph."""
    return f"<p{_class(kind)}>{escape(text)}</p>"


def section(anchor: str, title: str, parts: Iterable[str]) -> str:
    """Write a section with a heading."""
    body = "\n".join(parts)
    return f'<section id="{escape(anchor)}">\n<h2>{escape(title)}</h2>\n{body}\n</section>'


def header(title: str, about: Sequence[str]) -> str:
    """Write the page's title, and what it is about."""
    return f"<header><h1>{escape(title)}</h1>{paragraph(' · '.join(about))}</header>"


def verdict(level: str, label: str, text: str) -> str:
    """Write what it all comes to; the level is good, care, bad or unknown."""
    return f'<div class="verdict {escape(level)}" id="verdict">{paragraph(label, "label")}{paragraph(text)}</div>'


def contents(entries: Sequence[tuple[str, str]]) -> str:
    """Write links to sections: anchor and title."""
    links = "".join(f'<li><a href="#{escape(anchor)}">{escape(title)}</a></li>' for anchor, title in entries)
    return f"<nav><ul>{links}</ul></nav>"


def subheading(text: str) -> str:
    """Write a heading within a section."""
    return f"<h3>{escape(text)}</h3>"


def preformatted(text: str) -> str:
    """Write text as a terminal shows it."""
    return f"<pre>{escape(text)}</pre>"


def bullets(items: Sequence[str], ordered: bool = False) -> str:
    """Write a list."""
    tag = "ol" if ordered else "ul"
    return f"<{tag}>" + "".join(f"<li>{escape(item)}</li>" for item in items) + f"</{tag}>"


def definitions(pairs: Sequence[tuple[str, str]]) -> str:
    """Write names and values side by side."""
    return '<dl class="figures">' + "".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in pairs
    ) + "</dl>"  # fmt: skip


def table(content: Table) -> str:
    """Write a table; its first column names the rows."""
    head = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in content.header)
    body = "".join(
        f'<tr><th scope="row">{escape(first)}</th>' + "".join(f"<td>{escape(cell)}</td>" for cell in rest) + "</tr>"
        for first, *rest in content.rows
    )
    caption = f"<caption>{escape(content.title)}</caption>" if content.title else ""
    written = f"<table>{caption}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    note = paragraph(content.note, "note") if content.note else ""
    return f'<div class="table">{written}{note}</div>'


def bars(rows: Sequence[tuple[str, float, str]], unit: str) -> str:
    """Write horizontal bars: name, share of the width in 0..1, and what is written beside."""
    body = "".join(
        f'<tr><th scope="row">{escape(name)}</th><td class="bar"><span style="width:{100 * share:.1f}%"></span></td>'
        f"<td>{escape(text)}</td></tr>"
        for name, share, text in rows
    )
    return f'<table class="bars"><tbody>{body}</tbody></table>{paragraph(unit, "note")}'


def folded(summary: str, body: str) -> str:
    """Write something long that is opened by a click."""
    return f"<details><summary>{escape(summary)}</summary>{body}</details>"


def figure(picture: Picture) -> str:
    """Write a picture, embedded."""
    kind, data = ("svg+xml", picture.svg) if picture.svg is not None else ("png", picture.png)
    text = base64.b64encode(data).decode("ascii")
    image = f'<img alt="{escape(picture.alt)}" src="data:image/{kind};base64,{text}">'
    return f"<figure>{image}<figcaption>{escape(picture.caption)}</figcaption></figure>"


def document(title: str, style: str, body: str) -> str:
    """Write the whole page; it loads nothing."""
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n<main>\n{body}\n</main>\n</body>\n"
        "</html>\n"
    )


def _class(kind: str) -> str:
    return f' class="{escape(kind)}"' if kind else ""
