"""The replay's page in a real browser: how much of the road it shows."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from cosim.report.replay.page import page
from tests.service.browser import Tab, launched, needed
from tests.unit.test_replay_drawing import driven

pytestmark = needed


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tab]:
    """The page of an episode on a straight road."""
    file = tmp_path_factory.mktemp("replay") / "replay.html"
    file.write_text(page(driven()[0]), "utf-8")
    with launched() as browser:
        found = Tab(browser)
        found.page.goto(file.as_uri())
        found.until("window.replay && replay.shown.length > 0")
        yield found
        assert found.wrong == []
        found.close()


def test_a_straight_road_fills_the_screen_in_rows(tab: Tab) -> None:
    assert tab.tell("replay.view.rows") > 1
    seen = "replay.shown.map(([v]) => v.id).length === new Set(replay.shown.map(([v]) => v.id)).size"
    assert tab.tell(seen), "each vehicle once"


def test_a_place_on_the_screen_is_the_same_place_on_the_road(tab: Tab) -> None:
    error = """(() => {
      const { view } = replay, [x, y] = view.toMetres(view.width / 4, view.middle + 9);
      const [px, py] = view.toPixels(x, y);
      return Math.hypot(px - view.width / 4, py - view.middle - 9);
    })()"""
    assert tab.tell(error) < 1e-6
    above = """(() => {
      const { view } = replay, [x] = view.toMetres(view.width, 0), [next] = view.toMetres(0, view.high + 1);
      return next - x;
    })()"""
    assert abs(tab.tell(above)) < 1e-6, "a row begins where the row above it ends"


def test_the_whole_net_fits_into_one_row(tab: Tab) -> None:
    tab.page.keyboard.press("0")
    tab.until("replay.view.rows === 1")
