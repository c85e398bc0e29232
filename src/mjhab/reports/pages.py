"""Pages: templates of the package, filled in, as one HTML file that needs no network.

A page extends ``reports/templates/base.html``, which has the style, the script and the charts, and uses the elements of
``reports/templates/parts.html``. Everything that a template is given is escaped, but what `packed` and `base64_text`
return.
"""

from __future__ import annotations

import base64
import functools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from mjhab.core.names import kind_of
from mjhab.reports import words
from mjhab.reports.plots import Figure, has_values, kind_color, tone

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup


@dataclass(frozen=True)
class Section:
    """A section of `render_sections`: a chart, a table, a picture, or several of these.

    Attributes:
        title: its head.
        hint: what the reader must know, in a few sentences.
        chart: name of a figure.
        columns: name and class of every column: "n" for numbers, "words" for text that may wrap, "" for others.
        rows: cells of the table.
        picture: a PNG file; ``picture_says`` is what it shows.
    """

    title: str
    hint: str
    chart: str = ""
    columns: Sequence[tuple[str, str]] = ()
    rows: Sequence[Sequence[object]] = ()
    picture: bytes = b""
    picture_says: str = ""


def render_sections(
    title: str,
    sections: Sequence[Section],
    plots: Mapping[str, Figure] | None = None,
    about: str = "",
) -> str:
    """Return a page of sections below a title and what it is ``about``; ``plots`` as of `render_page`."""
    return render_page(
        "reports/templates/sections.html",
        title=title,
        about=about,
        sections=sections,
        plots=plots,
    )


def render_page(
    template: str,
    *,
    plots: Mapping[str, Figure] | None = None,
    force: Sequence[Figure] = (),
    **values: Any,
) -> str:
    """Return a page.

    Args:
        template: its path in the package, such as "reports/templates/run.html".
        plots: plotly figures by the names of their places, see ``chart`` in ``parts.html``. The template is given those
            that have values.
        force: figures that a menu ``force-episode`` chooses from, for the place ``force-plot``.
        values: what the template uses, "title" among it.

    Raises:
        jinja2.UndefinedError: the template uses a value that is not given.
    """
    drawn = {name: figure for name, figure in (plots or {}).items() if has_values(figure)}
    # Without blanks, as pages hold many numbers.
    data = json.dumps(
        {"plots": drawn, "force": list(force)}, separators=(",", ":"), allow_nan=False
    )
    # "</script>" in a text would end the script that holds the data.
    figures = _as_is(data.replace("</", "<\\/"))
    return (
        _environment()
        .get_template(template)
        .render(plots=drawn, figures=figures, **values)
    )


def base64_text(data: bytes) -> Markup:
    """Bytes as base64, which needs no escaping."""
    return _as_is(base64.b64encode(data).decode("ascii"))


@functools.cache
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        # From the root: pages of all packages extend one base.
        loader=PackageLoader("mjhab", "."),
        autoescape=True,
        # A name that a page lacks is an error, and no empty cell.
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {
        "base64_text": base64_text,
        "duration": words.duration,
        "kind_color": kind_color,
        "kind_of": kind_of,
        "newtons": words.newtons,
        "percent": words.percent,
        "spaced": words.spaced,
        "tone": tone,
    }
    environment.globals |= {
        "not_judged": words.NOT_JUDGED,
        "packed": _packed,
        "plotly": _plotly,
    }
    return environment


def _packed(path: str) -> Markup:
    """The text of a file of the package, as it is: a style or a script."""
    return _as_is(files("mjhab").joinpath(path).read_text(encoding="utf-8"))


def _plotly() -> Markup:
    from plotly.offline import get_plotlyjs

    return _as_is(get_plotlyjs())


def _as_is(text: str) -> Markup:
    """Text that is not escaped: the caller knows what is in it."""
    from markupsafe import Markup

    return Markup(text)
