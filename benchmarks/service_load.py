"""Two browsers and four sessions at once: pictures a second, memory, errors.

    python -m benchmarks.service_load [--minutes 10] [--policy vfn-p]

Starts a separate server. Each browser drives and watches a contested merge, episode after episode, in real
time; two programs drive one session each over JSON, also in real time. Pictures are distinct frames per
second of driving; the warm-ups of later episodes count as "waited". Needs Chromium (Debian: apt-get install
chromium).
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
import threading
import time
import urllib.request
from pathlib import Path
from typing import Any

from playwright.sync_api import Page, sync_playwright

from cosim.errors import CosimError
from tests.service.servers import Server

DECISION = 0.4  # s
COUNT = """() => {
  window.drawn = 0; window.driven = 0; let last = -1, before = performance.now(); const own = drawScene;
  drawScene = (ctx, state) => {
    if (state.t !== last) { drawn += 1; last = state.t; }
    own(ctx, state);
  };
  const tick = (now) => {
    if (replay.playing) driven += (now - before) / 1000;
    before = now; requestAnimationFrame(tick);
  };
  requestAnimationFrame(tick);
}"""
HEADS = (
    "minute", "pictures/s", "slowest 10 s", "waited s", "vehicles", "server MB", "sessions MB", "page MB",
    "errors",
)  # fmt: skip


def main() -> None:
    """Drive and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--policy", default="vfn-p")
    args = parser.parse_args()
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        raise SystemExit("no Chromium is installed: apt-get install chromium")
    stop, wrong = threading.Event(), list[str]()
    with (
        tempfile.TemporaryDirectory() as folder,
        sync_playwright() as playwright,
        Server(Path(folder, "data")) as server,
    ):
        try:
            url = server.url
            threads = [threading.Thread(target=_program, args=(url, args.policy, stop, wrong)) for _ in "ab"]
            for thread in threads:
                thread.start()
            browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
            pages = [_page(browser.new_context().new_page(), url, args.policy, wrong) for _ in "ab"]
            _measure(pages, server.process.pid, server.log, wrong, args.minutes)
            stop.set()
            browser.close()
            for thread in threads:
                thread.join()
        finally:
            stop.set()


def _measure(pages: list[Page], pid: int, log: Path, wrong: list[str], minutes: float) -> None:
    """Print one row per minute."""
    print(f"| {' | '.join(HEADS)} |\n|{'---|' * len(HEADS)}", flush=True)
    began = time.monotonic()
    before = [_drawn(page) for page in pages]
    minute, rates, driven, since = 0, list[float](), 0.0, began
    while time.monotonic() - began < 60.0 * minutes:
        pages[0].wait_for_timeout(10_000)
        now = [_drawn(page) for page in pages]
        for (drawn, s), (drawn_before, s_before) in zip(now, before, strict=True):
            driven += s - s_before
            if s - s_before > 1.0:
                rates.append((drawn - drawn_before) / (s - s_before))
        before = now
        if time.monotonic() - began < 60.0 * (minute + 1):
            continue
        minute += 1
        vehicles = [p.evaluate("() => replay.shown.length && replay.data.vehicles.length") for p in pages]
        heap = max(p.evaluate("() => performance.memory.usedJSHeapSize / 1e6") for p in pages)
        own, others = _memory(pid)
        faults = [*wrong, *(line for line in log.read_text().splitlines() if '"level": "info"' not in line)]
        row = (
            str(minute), f"{sum(rates) / len(rates):.1f}", f"{min(rates):.1f}",
            f"{time.monotonic() - since - driven / len(pages):.0f}", f"{min(vehicles)}",
            f"{own:.0f}", f"{others:.0f}", f"{heap:.0f}", str(len(faults[1:])),
        )  # fmt: skip
        print(f"| {' | '.join(row)} |", flush=True)
        rates, driven, since = [], 0.0, time.monotonic()
    for fault in [*wrong][:10]:
        print(fault)


def _page(page: Page, url: str, policy: str, wrong: list[str]) -> Page:
    """A browser page that drives and shows episode after episode."""
    page.on("pageerror", lambda error: wrong.append(f"page: {error}"))
    page.on("console", lambda line: wrong.append(f"console: {line.text}") if line.type == "error" else None)
    page.goto(url)
    page.wait_for_selector("#scenario option[value=contested]", state="attached")
    page.select_option("#scenario [name=policy]", policy)
    page.click("#go", timeout=120_000)
    while not page.evaluate("() => Boolean(window.replay && replay.t > 0.5)"):
        if text := page.inner_text("#wrong") or page.inner_text("#said"):
            raise SystemExit(f"the page shows: {text}")
        page.wait_for_timeout(200)
    page.check("#on")
    page.evaluate(COUNT)
    return page


def _drawn(page: Page) -> tuple[float, float]:
    """Number of pictures and s of driving so far."""
    drawn, driven = page.evaluate("() => [drawn, driven]")
    return float(drawn), float(driven)


def _program(url: str, policy: str, stop: threading.Event, wrong: list[str]) -> None:
    """Drive a session in real time, with idle AVs except those of the policy."""

    def ask(method: str, path: str, document: Any = None) -> Any:
        body = None if document is None else json.dumps(document).encode()
        request = urllib.request.Request(
            url + path, body, {"Content-Type": "application/json"}, method=method
        )
        with urllib.request.urlopen(request, timeout=120.0) as answer:
            return json.loads(answer.read() or b"null")

    try:
        words = {"scenario": "merge", "demand": "contested", "policy": policy, "maps": False}
        path = f"/api/sessions/{ask('POST', '/api/sessions', words)['id']}"
        while not stop.is_set():
            over = ask("POST", f"{path}/reset", {})["over"]
            while not over and not stop.is_set():
                began = time.monotonic()
                over = ask("POST", f"{path}/act", {"actions": {}})["over"]
                stop.wait(max(DECISION - (time.monotonic() - began), 0.0))
        ask("DELETE", path)
    except (OSError, CosimError, ValueError) as error:
        wrong.append(f"program: {error}")


def _memory(pid: int) -> tuple[float, float]:
    """Resident MB of the server, and of all its child processes."""
    sizes = {}
    for entry in Path("/proc").iterdir():
        try:
            status = dict(line.split(":", 1) for line in (entry / "status").read_text().splitlines())
            sizes[int(entry.name)] = int(status["PPid"]), int(status["VmRSS"].split()[0]) / 1024.0
        except (OSError, ValueError, KeyError):
            continue
    return sizes[pid][1], sum(size for parent, size in sizes.values() if parent == pid)


if __name__ == "__main__":
    main()
