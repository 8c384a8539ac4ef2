"""The page in a real browser: what a user does, and what he sees."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser

from tests.service.browser import Tab, launched, needed
from tests.service.servers import Server

pytestmark = needed


@pytest.fixture(scope="module")
def browser(server: Server) -> Iterator[Browser]:
    """One for all; its sessions are closed in the end."""
    with launched() as found:
        yield found
    for one in server.http.get("/api/sessions").json():
        server.http.delete(f"/api/sessions/{one['id']}")


@pytest.fixture(scope="module")
def tab(browser: Browser, server: Server) -> Iterator[Tab]:
    """A tab on the page; it has asked nobody but the server, and nothing went wrong in it."""
    found = Tab(browser)
    found.page.goto(server.url)
    yield found
    assert found.wrong == []
    host = server.url.partition("//")[2]
    assert {url.split("/")[2] for url in found.asked if not url.startswith("data:")} == {host}
    found.close()


def begin(tab: Tab, **fields: str) -> None:
    """Fill the form and start."""
    tab.until("document.querySelector('#go') && !document.querySelector('#go').disabled")
    tab.page.evaluate("document.querySelector('#scenario details').open = true")
    for name, value in fields.items():
        place = tab.page.locator(f"#scenario [name={name}]")
        if place.evaluate("e => e.tagName") == "SELECT":
            place.select_option(value)
        else:
            place.fill(value)
    tab.page.click("#go")
    tab.until("window.replay && document.querySelector('#start').hidden")


MOVED = """(() => {
  const {data, t} = replay;
  const at = (s) => data.vehicles.map((v) => stateOf(data, v, s)).filter(Boolean).map((s) => s.x);
  return at(0).length > 40 && Math.abs(at(t)[20] - at(0)[20]) > 5;
})()"""


def test_a_scenario_is_started_moves_pauses_steps_and_ends(tab: Tab) -> None:
    begin(tab, scenario="merge", demand="contested", policy="altruist-rule", duration="30", seed="200007")
    tab.until("replay.t > 1.0")
    assert tab.tell(MOVED)
    tab.page.keyboard.press(" ")
    assert not tab.tell("replay.playing")
    there = tab.tell("replay.t")
    tab.page.wait_for_timeout(600)
    assert tab.tell("replay.t") == there
    driven = tab.tell("replay.data.end")
    assert driven < 30.0  # who pauses drives nothing
    for _ in range(14):
        tab.page.keyboard.press("ArrowRight")
        tab.page.wait_for_timeout(60)
    tab.until(f"replay.data.end > {driven}")
    tab.page.keyboard.press("Home")
    assert tab.tell("replay.t") == 0
    tab.page.keyboard.press("End")
    tab.page.locator("#speed").select_option("8")
    tab.page.locator("#speed").evaluate("e => e.blur()")
    tab.page.keyboard.press(" ")
    tab.until("replay.data.over && replay.t >= 29.9")
    assert "of 1: 0.0 %" in tab.page.inner_text("#crashes")
    everybody = tab.page.inner_text("#everybody")
    assert re.search(r"\d s\n", everybody)
    assert re.search(
        r"AVs [\d.]+, humans [\d.]+ s, longest wait \d+ s, \d+ arrived, [\d.]+ kg CO2", everybody
    )
    assert "trace " in tab.page.locator("#figures").text_content()
    assert not tab.tell("replay.playing")


def test_the_next_seed_and_another_scenario_by_keyboard(tab: Tab) -> None:
    tab.page.keyboard.press("e")
    tab.until("replay.data.facts.seed === 200008 && replay.t > 0.5")
    tab.page.keyboard.press("?")
    assert tab.page.locator("#keys kbd", has_text="e").first.is_visible()
    tab.page.keyboard.press("Escape")
    tab.page.keyboard.press("s")
    tab.until("!document.querySelector('#start').hidden")
    begin(tab, scenario="intersection", demand="dense", policy="vfn-p", duration="8")
    tab.until("replay.data.facts.scenario === 'intersection' && replay.t > 1")
    tab.until("replay.data.vehicles.some((v) => v.choices.some((c) => c.q))")
    assert tab.tell("replay.data.forecasts.some(Boolean)")
    assert tab.tell("replay.data.stopLines.length > 0")


def test_a_run_is_submitted_and_finishes_and_two_policies_are_compared(
    browser: Browser, server: Server
) -> None:
    tab = Tab(browser)
    tab.page.goto(f"{server.url}/runs")
    tab.until("document.querySelector('#by').options.length > 3")
    tab.page.keyboard.press("a")
    evil = "<img src=x onerror=alert(1)>"
    for name, value in {"name": evil, "count": "2", "duration": "2"}.items():
        tab.page.fill(f"#run [name={name}]", value)
    tab.page.locator("#run [name=policy]").select_option(["idm", "altruist-rule"])
    tab.page.click("#submit")
    tab.until("document.querySelector('#one h2') && document.querySelectorAll('#one table').length === 2")
    assert tab.page.inner_text("#one h2") == evil  # a text, whatever it holds
    assert tab.page.locator("#one .chip").inner_text() == "finished"
    assert tab.page.locator("#one .scroll").first.locator("tr").count() == 3
    link = tab.page.locator("#one a", has_text="replay").first.get_attribute("href") or ""
    assert link.startswith("/api/runs/")
    own = f"Array.from(document.querySelector('#b').options).findIndex((o) => o.text.includes({evil!r}) && "
    tab.page.locator("#a").select_option(index=tab.tell(f"{own}o.value.endsWith(':idm'))"))
    tab.page.locator("#b").select_option(index=tab.tell(f"{own}o.value.endsWith(':altruist-rule'))"))
    tab.page.click("#set-against")
    tab.until("document.querySelector('#verdict table')")
    assert "2 pairs" in tab.page.inner_text("#verdict")
    assert tab.page.locator("#verdict td", has_text="0 of 2").count() >= 2
    tab.page.fill("#find", "nobody calls it that")
    assert tab.page.locator("#list li").count() == 0
    tab.page.fill("#find", "onerror")
    assert tab.page.locator("#list li").count() == 1
    assert tab.wrong == []
    tab.close()


def test_it_fits_a_telephone_in_the_dark(browser: Browser, server: Server) -> None:
    tab = Tab(browser, wide=420, high=800, dark=True)
    tab.page.goto(server.url)
    begin(tab, policy="idm", duration="2")
    tab.until("replay.t > 0.5")
    assert tab.tell("document.documentElement.scrollWidth") <= 420
    assert tab.tell("document.documentElement.classList.contains('dark')")
    assert tab.page.locator("#scene").bounding_box()["height"] > 150  # type: ignore[index]
    tab.page.goto(f"{server.url}/runs")
    tab.until("document.querySelectorAll('#list li').length || !document.querySelector('#none').hidden")
    assert tab.tell("document.documentElement.scrollWidth") <= 420
    assert tab.wrong == []
    tab.close()
