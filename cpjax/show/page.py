"""A report as one self-contained HTML page: no script, no request, embedded pictures."""

import base64
import html
from collections.abc import Sequence
from pathlib import Path

from cpjax import files

_STYLE = """
:root { color-scheme: light dark; --ink: #1b1f24; --paper: #ffffff; --soft: #5b6570; --line: #d8dee4; --band: #f4f6f8; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e6e9ec; --paper: #14171a; --soft: #9aa4ae; --line: #333a41; --band: #1d2226; }
}
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 72rem; padding: 1.5rem 1rem 4rem; background: var(--paper); color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
h1 { line-height: 1.2; font-size: 1.9rem; margin: 0.5rem 0; } h2 { margin-top: 2.6rem; font-size: 1.35rem; }
p.lead { font-size: 1.1rem; color: var(--soft); } figure { margin: 1.5rem 0; }
figure img { display: block; width: 100%; height: auto; background: #fff; }
@media screen and (max-width: 44rem) { figure img { width: 44rem; } }
figcaption, .note { color: var(--soft); font-size: 0.93rem; margin-top: 0.4rem; }
nav ol { columns: 2; padding-left: 1.4rem; } @media screen and (max-width: 44rem) { nav ol { columns: 1; } }
a { color: inherit; } summary { cursor: pointer; color: var(--soft); }
.numbers { display: grid; grid-template-columns: repeat(auto-fit, minmax(13rem, 1fr)); gap: 0.8rem; margin: 1.2rem 0; }
.numbers div { background: var(--band); border-radius: 6px; padding: 0.7rem 0.9rem; } .numbers b { font-size: 1.5rem; }
.numbers span { display: block; color: var(--soft); font-size: 0.9rem; }
.scroll { overflow-x: auto; border: 1px solid var(--line); border-radius: 6px; }
table { border-collapse: collapse; width: 100%; font-size: 0.86rem; font-variant-numeric: tabular-nums; }
th, td { padding: 0.35rem 0.45rem; text-align: right; white-space: nowrap; }
th { background: var(--band); font-weight: 600; vertical-align: bottom; white-space: normal; }
th.text, td.text { text-align: left; } tbody tr + tr td { border-top: 1px solid var(--line); }
code { font-size: 0.92em; background: var(--band); padding: 0.05em 0.3em; border-radius: 4px; }
@media print {
  nav { display: none; } body { max-width: none; } figure, tr { break-inside: avoid; }
  .scroll { overflow: visible; border: 0; } table { font-size: 0.7rem; }
}
"""


_MOST_ROWS = 6
"""A longer table is folded."""


class Page:
    """Collects sections in order and writes them as one file, with a table of contents before the first."""

    def __init__(self, title: str, lead: str) -> None:
        self._title = title
        self._head = [f"<h1>{html.escape(title)}</h1>", f'<p class="lead">{html.escape(lead)}</p>']
        self._sections: list[str] = []
        self._parts: list[str] = []

    @property
    def _body(self) -> list[str]:
        """Returns the list that content is added to: before the first section, the head of the page."""
        return self._parts if self._sections else self._head

    def section(self, title: str) -> None:
        """Begins a section."""
        self._sections.append(title)
        self._body.append(f'<h2 id="part-{len(self._sections)}">{html.escape(title)}</h2>')

    def numbers(self, numbers: Sequence[tuple[str, str, str]]) -> None:
        """Adds a row of numbers, each as text with a second line, such as its interval, and what it is."""
        boxes = [
            f"<div><b>{html.escape(value)}</b> {html.escape(more)}<span>{html.escape(what)}</span></div>"
            for value, more, what in numbers
        ]
        self._body.append(f'<div class="numbers">{"".join(boxes)}</div>')

    def text(self, text: str) -> None:
        """Adds a paragraph; text between backticks is set as code."""
        self._body.append(f"<p>{_inline(text)}</p>")

    def note(self, text: str) -> None:
        """Adds a paragraph in small print."""
        self._body.append(f'<p class="note">{_inline(text)}</p>')

    def table(self, header: Sequence[str], rows: Sequence[Sequence[str]], text_columns: int) -> None:
        """Adds a table whose first `text_columns` columns are words, the others numbers. A long one is folded."""

        def row(tag: str, cells: Sequence[str]) -> str:
            kinds = [' class="text"' if i < text_columns else "" for i in range(len(cells))]
            return "".join(f"<{tag}{k}>{html.escape(c)}</{tag}>" for k, c in zip(kinds, cells, strict=True))

        body = "\n".join(f"<tr>{row('td', cells)}</tr>" for cells in rows)
        head = f"<thead><tr>{row('th', header)}</tr></thead>"
        table = f'<div class="scroll"><table>{head}<tbody>\n{body}\n</tbody></table></div>'
        if len(rows) > _MOST_ROWS:
            table = f"<details><summary>Table of {len(rows)} rows</summary>{table}</details>"
        self._body.append(table)

    def picture(self, content: bytes, caption: str, kind: str = "png") -> None:
        """Adds a figure from the content of an image file, `kind` png or gif; the caption says what to see."""
        data = base64.b64encode(content).decode("ascii")
        alt = html.escape(caption, quote=True)
        image = f'<img alt="{alt}" src="data:image/{kind};base64,{data}">'
        self._body.append(
            f'<figure><div class="scroll">{image}</div><figcaption>{_inline(caption)}</figcaption></figure>'
        )

    def write(self, path: Path) -> None:
        """Writes the page atomically."""
        links = [
            f'<li><a href="#part-{number}">{html.escape(title)}</a></li>'
            for number, title in enumerate(self._sections, start=1)
        ]
        contents = f'<nav aria-label="Contents"><ol>{"".join(links)}</ol></nav>'
        body = "\n".join([*self._head, contents, *self._parts])
        files.write_text(
            path,
            f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            f'<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            f"<title>{html.escape(self._title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n{body}\n</body>\n</html>\n",
        )


def _inline(text: str) -> str:
    """Returns the text escaped for HTML, with text between backticks as code."""
    pieces = html.escape(text).split("`")
    return "".join(f"<code>{piece}</code>" if i % 2 else piece for i, piece in enumerate(pieces))
