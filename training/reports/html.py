"""A one-page report: text, tables and pictures as plain HTML that needs nothing from elsewhere."""

import dataclasses
import html
from collections.abc import Sequence
from pathlib import Path

from thor2_jax.files import write_text

__all__ = ["Picture", "Section", "Table", "write_page"]

Table = tuple[Sequence[str], Sequence[Sequence[str]]]
"""Header and rows; the first column holds names, the others figures."""


@dataclasses.dataclass(frozen=True)
class Picture:
    """A picture beside the page.

    Attributes:
        path: relative to the page.
        caption: what it shows; also read out where it cannot be seen.
        half: two of them stand side by side on a wide screen.
        small: many of them stand side by side, on a narrow screen two.
    """

    path: str
    caption: str
    half: bool = False
    small: bool = False


Section = tuple[str, str, Table | None, Sequence[Picture]]
"""Heading, text, table, pictures."""

_STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #222; background: #fff; max-width: 72rem; margin: 0 auto;
  padding: 1rem; }
h1 { line-height: 1.2; margin-bottom: .3rem; }
.lead { color: #555; margin-top: 0; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; margin: 1rem 0; font-size: .9rem; }
th, td { padding: .3rem .6rem; text-align: right; border-bottom: 1px solid #ddd; font-variant-numeric: tabular-nums; }
th:first-child, td:first-child { text-align: left; }
.pictures { display: flex; flex-wrap: wrap; gap: 1rem; }
figure { margin: 0; flex: 1 1 100%; }
figure.half { flex: 1 1 26rem; max-width: calc(50% - .5rem); }
figure.small { flex: 0 1 10rem; max-width: calc(50% - .5rem); }
@media (max-width: 56rem) { figure.half { max-width: 100%; } }
img { max-width: 100%; height: auto; display: block; }
figcaption { color: #555; font-size: .9rem; }
"""


def _table(table: Table) -> str:
    header, rows = table
    head = "".join(f'<th scope="col">{html.escape(cell)}</th>' for cell in header)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _figure(picture: Picture) -> str:
    path, caption = html.escape(picture.path), html.escape(picture.caption)
    kind = ' class="half"' if picture.half else ' class="small"' if picture.small else ""
    return f'<figure{kind}><img src="{path}" alt="{caption}"><figcaption>{caption}</figcaption></figure>'


def write_page(path: str | Path, *, title: str, lead: str, sections: Sequence[Section]) -> None:
    """Write the page; it appears whole or not at all.

    Raises:
        OSError: it cannot be written.
    """
    parts = [f"<h1>{html.escape(title)}</h1>", f'<p class="lead">{html.escape(lead)}</p>']
    for heading, text, table, pictures in sections:
        parts.append(f"<h2>{html.escape(heading)}</h2>")
        if text:
            parts.append(f"<p>{html.escape(text)}</p>")
        if table is not None:
            parts.append(_table(table))
        parts.append(f'<div class="pictures">{"".join(map(_figure, pictures))}</div>')
    write_text(
        path,
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style></head><body>\n"
        + "\n".join(parts)
        + "\n</body></html>\n",
    )
