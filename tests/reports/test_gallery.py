"""What every page in the common style promises, as far as it can be read without a browser.

`make test-browser` looks at the same pages in Chromium at two widths.
"""

from __future__ import annotations

import json
import re

import pytest

from mjhab.reports.plots import has_values
from tests.reports.gallery import pages


@pytest.fixture(scope="module")
def gallery(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    return pages(tmp_path_factory.mktemp("gallery"))


def body_of(page: str) -> str:
    return page[page.index("<main>") : page.index("</main>")]


def plots_of(page: str) -> dict[str, dict]:
    found = re.search(r'id="page-data">(.*?)</script>', page, re.S)
    assert found is not None
    return json.loads(found[1].replace("<\\/", "</")).get("plots", {})


def test_no_chart_is_empty_and_every_chart_has_a_place(gallery: dict[str, str]) -> None:
    """Plotly draws an axis from -1 to 6 for a chart without values."""
    for name, page in gallery.items():
        plots = plots_of(page)
        assert all(has_values(figure) for figure in plots.values()), name
        for plot in plots:
            assert f'<div id="{plot}"></div>' in body_of(page), (name, plot)
    for name in ("training_none", "reward_none"):
        assert not plots_of(gallery[name]) and "No values yet." in gallery[name]


def test_a_curve_of_one_point_begins_at_zero(gallery: dict[str, str]) -> None:
    for figure in plots_of(gallery["training"]).values():
        x_axis = figure["layout"]["xaxis"]
        assert x_axis.get("rangemode") == "tozero" or "range" in x_axis


def test_every_table_scrolls_on_a_narrow_page(gallery: dict[str, str]) -> None:
    for name, page in gallery.items():
        body = body_of(page)
        tables = len(re.findall("<table", body))
        assert len(re.findall('<div class="scroll"><table', body)) == tables, name


def test_without_films_there_is_no_room_for_films(gallery: dict[str, str]) -> None:
    words = body_of(gallery["run"])
    assert "no film" not in words and "Films run at" not in words
    assert body_of(gallery["run"]).count('<div class="timeline">') == 4
    assert body_of(gallery["run_films"]).count("<video") == 3
