"""A single HTML page that needs no network, and no file beside it."""

import base64
from collections.abc import Iterable, Sequence
from html import escape
from typing import Literal

STYLE = """
:root { color-scheme: light; }
* { box-sizing: border-box; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 76rem; margin: 1.5rem auto; padding: 0 1rem; color: #1c2430; }
h1, p, summary, td.long, .card { overflow-wrap: anywhere; }
h1 { font-size: 1.6rem; margin-bottom: 0; } h2 { font-size: 1.25rem; margin-top: 2.2rem; }
h3 { font-size: 1.02rem; margin: 1.4rem 0 .3rem; }
.notice { background: #fff4d6; border-left: 4px solid #d99a00; padding: .5rem .8rem; }
.bad { color: #b3261e; font-weight: 600; } .good { color: #1b7f3b; font-weight: 600; }
.cards { display: flex; flex-wrap: wrap; gap: .7rem; margin: 1rem 0; }
.card { flex: 1 1 9.5rem; border: 1px solid #d7dee7; border-radius: .4rem; padding: .5rem .8rem; }
.card b { display: block; font-size: 1.35rem; font-variant-numeric: tabular-nums; } .card span { color: #4b5866; }
.wide { overflow-x: auto; max-width: 100%; }
table { border-collapse: collapse; margin: .3rem 0; font-size: .88rem; font-variant-numeric: tabular-nums; }
th, td { padding: .18rem .6rem; text-align: right; white-space: nowrap; vertical-align: top; }
th { border-bottom: 2px solid #8593a5; vertical-align: bottom; white-space: normal; min-width: 4rem; }
.text, th:first-child { text-align: left; } td.long { white-space: normal; min-width: 18rem; text-align: left; }
tr.paper td { color: #5d6976; } tbody tr { border-bottom: 1px solid #e3e8ee; }
.note, figcaption { color: #4b5866; font-size: .88rem; margin: .2rem 0 .8rem; }
figure { margin: 1rem 0; } img { max-width: 100%; height: auto; }
summary { cursor: pointer; font-weight: 600; margin: .8rem 0; font-size: 1.05rem; }
@media screen and (max-width: 42rem) { figure .wide img { max-width: none; width: 42rem; } }
@media print { html { font-size: 11px; } body { max-width: none; margin: 0; font-size: 1rem; }
  .wide { overflow: visible; } table { font-size: .8rem; }
  th, td { padding: .1rem .25rem; white-space: normal; } th, td.long { min-width: 0; }
  figure, .card, tr { break-inside: avoid; } h2, h3 { break-after: avoid; } }
"""
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"  # nothing is ever loaded


def page(title: str, parts: Iterable[str]) -> str:
    """The text of an HTML file with these parts of a body."""
    head = (
        f'<meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}</style>"
    )
    body = "\n".join(part for part in parts if part)
    return f'<!doctype html>\n<html lang="en"><head>{head}</head><body>\n{body}\n</body></html>\n'


def cards(entries: Iterable[tuple[str, str, str]]) -> str:
    """Large numbers, each with what it is above and a remark below."""
    boxes = (
        f'<div class="card"><span>{escape(what)}</span><b>{escape(value)}</b><span>{escape(remark)}</span></div>'
        for what, value, remark in entries
    )
    return f'<div class="cards">{"".join(boxes)}</div>'


def image(picture: bytes, alt: str, caption: str, kind: Literal["png", "jpeg"] = "png") -> str:
    """A picture within the page."""
    source = base64.b64encode(picture).decode("ascii")
    shown = f'<img alt="{escape(alt)}" src="data:image/{kind};base64,{source}">'
    return f'<figure><div class="wide">{shown}</div><figcaption>{escape(caption)}</figcaption></figure>'


def listing(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of text; its last column may be long."""
    head = "".join(f'<th class="text">{escape(column)}</th>' for column in columns)
    last = len(columns) - 1
    lines = (
        "".join(f'<td class="{"long" if n == last else "text"}">{escape(cell)}</td>' for n, cell in enumerate(row))
        for row in rows
    )
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def folded(title: str, parts: Iterable[str]) -> str:
    """Parts that can be folded away; open at first, so that they are printed."""
    return f"<details open><summary>{escape(title)}</summary>{''.join(parts)}</details>"
