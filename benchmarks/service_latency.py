"""Latency of a session's step over HTTP, compared with the same step of `cosim.open` on this machine.

    cosim serve &
    python -m benchmarks.service_latency [--url http://127.0.0.1:8000] [--scenario merge] [--episodes 3]

Both drive the same episodes in alternating decisions, so that other load affects both equally.
"""

from __future__ import annotations

import argparse
import http.client
import json
import time
from statistics import median, quantiles
from typing import Any
from urllib.parse import urlsplit

import cosim
from cosim.envs.session import Session
from cosim.service import client
from cosim.types import MetaAction


class Json:
    """The same session over plain JSON."""

    def __init__(self, url: str, words: dict[str, Any]) -> None:
        parts = urlsplit(url)
        self._connection = http.client.HTTPConnection(parts.hostname or "", parts.port)
        self._path = f"/api/sessions/{self.ask('POST', '/api/sessions', words)['id']}"

    def ask(self, method: str, path: str, document: dict[str, Any] | None = None) -> Any:
        """The document of the response."""
        body = None if document is None else json.dumps(document)
        self._connection.request(method, path, body, {"Content-Type": "application/json"})
        return json.loads(self._connection.getresponse().read() or b"null")

    def reset(self, seed: int) -> None:
        """Begin an episode."""
        self._avs = self.ask("POST", f"{self._path}/reset", {"seed": seed})["avs"]

    def step(self) -> None:
        """One decision."""
        document = {"actions": dict.fromkeys(self._avs, "IDLE")}
        self._avs = self.ask("POST", f"{self._path}/act", document)["avs"]

    def close(self) -> None:
        """End the session."""
        self.ask("DELETE", self._path)


def idle(session: Session) -> None:
    """One decision in which every AV keeps speed and lane."""
    session.act(dict.fromkeys(session.avs, MetaAction.IDLE))


def timed(work: Any, *arguments: Any) -> float:
    """Duration of the call in ms."""
    began = time.perf_counter()
    work(*arguments)
    return 1e3 * (time.perf_counter() - began)


def main() -> None:
    """Drive and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--url", default="http://127.0.0.1:8000")
    parser.add_argument("--scenario", default="merge")
    parser.add_argument("--episodes", type=int, default=3)
    args = parser.parse_args()
    words = {"demand": "contested"}
    took: dict[str, list[float]] = {"cosim.open": [], "client": [], "JSON": []}
    plain = Json(args.url, {"scenario": args.scenario, **words})
    avs = 0
    with (
        cosim.open(args.scenario, demand="contested") as local,
        client.open(args.url, args.scenario, demand="contested") as remote,
    ):
        for seed in range(args.episodes):
            for one in (local, remote, plain):
                one.reset(seed)
            while not local.over:
                avs = max(avs, len(local.avs))
                took["cosim.open"].append(timed(idle, local))
                took["client"].append(timed(idle, remote))
                took["JSON"].append(timed(plain.step))
    plain.close()
    own = median(took["cosim.open"])
    print(f"{args.scenario}: {len(took['client'])} decisions, {avs} AVs at most")
    print("| driven by | median ms | 95 % ms | above cosim.open, median ms |")
    print("|---|---|---|---|")
    for name, ms in took.items():
        print(f"| {name} | {median(ms):.2f} | {quantiles(ms, n=20)[-1]:.2f} | {median(ms) - own:+.2f} |")


if __name__ == "__main__":
    main()
