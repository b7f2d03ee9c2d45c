"""A report as one self-contained HTML page of text, tables and pictures."""

import dataclasses
import html
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from thor2_jax.files import write_text

__all__ = ["Picture", "Section", "Table", "write_page"]

Table = tuple[Sequence[str], Sequence[Sequence[str]]]
"""Header and rows; the first column holds names, the others values."""


@dataclasses.dataclass(frozen=True)
class Picture:
    """A picture in a file next to the page, or in the page.

    Attributes:
        path: path relative to the page, or a `data:` URL with the picture.
        caption: caption and alternative text.
        width: width on a wide screen: full, a half, a third, or small, so that many pictures fit side by side.
    """

    path: str
    caption: str
    width: Literal["full", "half", "third", "small"] = "full"


@dataclasses.dataclass(frozen=True)
class Section:
    """A section of the page: a heading, and optionally a paragraph, a table, pictures and a folded section."""

    heading: str
    text: str = ""
    table: Table | None = None
    pictures: Sequence[Picture] = ()
    folded: "Section | None" = None


_STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #222; background: #fff; max-width: 72rem; margin: 0 auto;
  padding: 1rem; overflow-wrap: break-word; }
h1 { line-height: 1.2; margin-bottom: .3rem; }
.lead { color: #555; margin-top: 0; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; margin: 1rem 0; font-size: .9rem; }
th, td { padding: .3rem .6rem; text-align: right; border-bottom: 1px solid #ddd; font-variant-numeric: tabular-nums; }
th:first-child, td:first-child { text-align: left; }
.pictures { display: flex; flex-wrap: wrap; gap: 1rem; }
figure { margin: 0; flex: 1 1 100%; }
figure.half { flex: 1 1 26rem; max-width: calc(50% - .5rem); }
figure.third { flex: 0 1 21rem; max-width: calc(33.3% - .7rem); }
figure.small { flex: 0 1 10rem; max-width: calc(50% - .5rem); }
@media (max-width: 56rem) { figure.half, figure.third { max-width: 100%; } }
img { max-width: 100%; height: auto; display: block; }
summary { color: #555; cursor: pointer; }
figcaption { color: #555; font-size: .9rem; }
"""


def _table(table: Table) -> str:
    header, rows = table
    head = "".join(f'<th scope="col">{html.escape(cell)}</th>' for cell in header)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _figure(picture: Picture) -> str:
    path, caption = html.escape(picture.path), html.escape(picture.caption)
    kind = "" if picture.width == "full" else f' class="{picture.width}"'
    return f'<figure{kind}><img src="{path}" alt="{caption}"><figcaption>{caption}</figcaption></figure>'


def _content(section: Section) -> str:
    elements = [f"<p>{html.escape(section.text)}</p>"] if section.text else []
    if section.table is not None:
        elements.append(_table(section.table))
    figures = "".join(map(_figure, section.pictures))
    elements.append(f'<div class="pictures">{figures}</div>')
    if section.folded is not None:
        summary = f"<summary>{html.escape(section.folded.heading)}</summary>"
        elements.append(f"<details>{summary}\n{_content(section.folded)}</details>")
    return "\n".join(elements)


def write_page(path: str | Path, *, title: str, lead: str, sections: Sequence[Section]) -> None:
    """Write the page atomically.

    Args:
        path: the page.
        title: title and heading.
        lead: paragraph below the heading.
        sections: sections of the page.

    Raises:
        OSError: the file cannot be written.
    """
    content = (f"<h2>{html.escape(each.heading)}</h2>\n{_content(each)}" for each in sections)
    write_text(
        path,
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style></head><body>\n"
        f'<h1>{html.escape(title)}</h1>\n<p class="lead">{html.escape(lead)}</p>\n'
        + "\n".join(content)
        + "\n</body></html>\n",
    )
