"""A session on a server, with the interface of `cosim.open`.

    from cosim.service import client

    with client.open("http://127.0.0.1:8000", "merge", demand="contested", svo=45) as session:
        views = session.reset(seed=7)
        while not session.over:
            views = session.act({av: my_agent(seen) for av, seen in views.items()}).observations

`client.resume` continues a failed run. The client needs only cosim itself. If the server requires a token,
pass `token` or set COSIM_TOKEN.
"""

from __future__ import annotations

import contextlib
import http.client
import io
import json
import os
import socket
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast
from urllib.parse import quote, urlencode, urlsplit

import numpy as np

import sumo_scenarios
from cosim.envs.session import TIMEOUT, Session
from cosim.errors import BadInput, CosimError, SimulationError
from cosim.scenario import Scenario, load
from cosim.service import wire
from cosim.service.settings import TOKEN
from cosim.types import COMPACT, ContinuousAction, EpisodeResult, ObservationConfig, Snapshot

FRESH = 60.0  # s without a request after which the server may have closed the connection


def open(
    url: str,
    what: str,
    *,
    token: str | None = None,
    timeout: float = TIMEOUT,
    observation: ObservationConfig = COMPACT,
    others: str | None = None,
    seed: int | None = None,
    **words: Any,
) -> Session:
    """Open a session on the server at `url`; `what` is a scenario's name, or `upload:ID`.

    `words` are the options of `cosim.open` that are text or numbers (`demand`, `behavior`, `svo`, ...), and
    `idle_s`, the idle time after which the session ends. `others` names the policy of the AVs that you do not
    command. `observation`: the compact size, with or without maps. `timeout`: s to wait for an answer.

    Raises:
        BadInput: the server refuses field and value; no server answers.
    """
    maps = observation.maps
    if observation != replace(COMPACT, maps=maps):
        raise BadInput("a server draws the compact size, with or without maps", field="observation")
    connection = Connection(url, token or os.environ.get(TOKEN), timeout)
    request = {"scenario": what, "policy": others or "idm", "maps": maps, "seed": seed, **words}
    return Remote(connection, {name: value for name, value in request.items() if value is not None})


def resume(url: str, run: str, *, token: str | None = None, timeout: float = TIMEOUT) -> dict[str, Any]:
    """Have the server at `url` continue a failed or cancelled run; returns the run's document.

    Raises BadInput: no such run, or it is not in that state; no server answers.
    """
    connection = Connection(url, token or os.environ.get(TOKEN), timeout)
    with contextlib.closing(connection):
        document: dict[str, Any] = json.loads(connection.request("POST", f"/api/runs/{quote(run)}/resume")[1])
    return document


class Remote(Session):
    """A session on a server. The `scenario` of an upload has names and times, but no local files."""

    def __init__(self, connection: Connection, request: Mapping[str, Any]) -> None:
        caller = _Caller(connection, request)
        about = caller.about
        known = {name: about[name] for name in ("behavior", "preset", "duration", "warmup")}
        if sumo_scenarios.ships(request["scenario"]):
            scenario = replace(load(request["scenario"]), demand_name=about["demand"], **known)
        else:
            elsewhere = Path(request["scenario"])
            scenario = Scenario(
                about["scenario"], elsewhere, elsewhere, (), demand_name=about["demand"], **known
            )
        super().__init__(scenario, lambda: caller, request.get("seed"))


class Connection:
    """One kept-alive connection to a server. Raises BadInput for an invalid `url` or without an answer."""

    def __init__(self, url: str, token: str | None, timeout: float) -> None:
        parts = urlsplit(url)
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise BadInput("http://HOST:PORT is needed", field="url", value=url)
        kind = http.client.HTTPSConnection if parts.scheme == "https" else http.client.HTTPConnection
        self._used = 0.0
        self._url, self._base = url, parts.path.rstrip("/")
        self._connection = kind(parts.hostname, parts.port, timeout=timeout)
        self._headers = {"Accept": wire.MEDIA, "Content-Type": "application/json"}
        if token:
            self._headers["Authorization"] = f"Bearer {token}"

    def request(self, method: str, path: str, document: object = None) -> tuple[str, bytes]:
        """Media type and body of the answer.

        Raises BadInput: the server refuses the request. SimulationError: the simulation failed. CosimError:
        the server is gone, or failed.
        """
        body = None if document is None else json.dumps(document)
        connection = self._connection
        try:
            if time.monotonic() - self._used > FRESH:
                connection.close()
            self._used = time.monotonic()
            if connection.sock is None:
                connection.connect()
                cast(socket.socket, connection.sock).setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.request(method, self._base + path, body, self._headers)
            answer = connection.getresponse()
            data = answer.read()
        except (OSError, http.client.HTTPException) as error:
            connection.close()
            if isinstance(error, ConnectionRefusedError | socket.gaierror):
                raise BadInput(f"no server answers: {error.strerror}", field="url", value=self._url) from None
            raise CosimError(f"{self._url}: the server is gone: {error or type(error).__name__}") from None
        if answer.status >= 400:
            raise _problem(answer.status, data, self._url)
        return answer.headers.get_content_type(), data

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()


class _Caller:
    """The session's `Caller`: sends requests to the server instead of a worker."""

    def __init__(self, connection: Connection, request: Mapping[str, Any]) -> None:
        self._connection = connection
        self.about: dict[str, Any] = json.loads(connection.request("POST", "/api/sessions", request)[1])
        self._path = f"/api/sessions/{self.about['id']}"

    def call(self, method: str, *arguments: Any) -> Any:
        """One method of `cosim.envs.host.SessionHost`."""
        if not hasattr(self, f"_{method}"):
            raise BadInput("is not available on a server", field=method)
        return getattr(self, f"_{method}")(*arguments)

    def close(self) -> None:
        """Close the session, if the server still has it."""
        with contextlib.suppress(CosimError):
            self._connection.request("DELETE", self._path)
        self._connection.close()

    def _reset(self, seed: int) -> Any:
        return wire.to_reply(self._connection.request("POST", f"{self._path}/reset", {"seed": seed})[1])

    def _act(self, actions: Mapping[str, Any], see: Sequence[str] | None) -> Any:
        asked = {
            av: action._asdict() if isinstance(action, ContinuousAction) else action
            for av, action in actions.items()
        }
        document = {"actions": asked, "see": None if see is None else list(see)}
        return wire.to_reply(self._connection.request("POST", f"{self._path}/act", document)[1])

    def _snapshot(self) -> Snapshot:
        return wire.to_snapshot(self._connection.request("GET", f"{self._path}/vehicles")[1])

    def _result(self, policy: str) -> EpisodeResult:
        query = urlencode({"policy": policy})
        return wire.to_result(json.loads(self._connection.request("GET", f"{self._path}/result?{query}")[1]))

    def _partner(self) -> str:
        return str(json.loads(self._connection.request("GET", f"{self._path}/partner")[1]))

    def _picture(self, av: str | None) -> Any:
        from PIL import Image

        query = "" if av is None else f"?av={quote(av)}"
        png = self._connection.request("GET", f"{self._path}/picture{query}")[1]
        return np.asarray(Image.open(io.BytesIO(png)))


def _problem(status: int, data: bytes, url: str) -> CosimError:
    """The exception for a server's refusal."""
    try:
        found = json.loads(data)
        problem, field, value, file = (found[name] for name in ("problem", "field", "value", "file"))
    except (ValueError, KeyError, TypeError):
        return CosimError(f"{url}: HTTP {status}")
    if status == 409 and "simulation failed" in problem:
        return SimulationError(problem)
    if status >= 500:
        return CosimError(f"{url}: {problem}")
    return BadInput(problem, file=file, field=field, value=value)
