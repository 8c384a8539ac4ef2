"""Monitoring for operators: figures in Prometheus' format, logs as lines of JSON."""

from __future__ import annotations

import json
import logging
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from prometheus_client import (
    CollectorRegistry,
    Counter,
    GCCollector,
    Histogram,
    PlatformCollector,
    ProcessCollector,
    generate_latest,
)
from prometheus_client.core import GaugeMetricFamily, Metric

_STANDARD = frozenset(vars(logging.makeLogRecord({})))  # fields of every record
log = logging.getLogger("cosim.service")
STEP_BUCKETS = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)  # s


class Figures:
    """The server's figures. `states`: name of a gauge -> (help, label, () -> value by label)."""

    def __init__(self, states: Mapping[str, tuple[str, str, Callable[[], Mapping[str, float]]]]) -> None:
        self._registry = CollectorRegistry()
        ProcessCollector(registry=self._registry)
        PlatformCollector(registry=self._registry)
        GCCollector(registry=self._registry)
        self._registry.register(_States(states))
        own = self._registry
        labels = ("method", "route", "status")
        self.requests = Counter("cosim_http_requests", "requests answered", labels, registry=own)
        self.seconds = Histogram(
            "cosim_http_request_seconds", "from request to answer", ("method", "route"), registry=own
        )
        self.episodes = Counter("cosim_episodes", "episodes driven", registry=own)
        self.steps = Histogram(
            "cosim_session_step_seconds", "a session's decision", buckets=STEP_BUCKETS, registry=own
        )

    def text(self) -> bytes:
        """All figures in Prometheus' text format."""
        return bytes(generate_latest(self._registry))


class _States:
    """Gauges computed on request."""

    def __init__(self, states: Mapping[str, tuple[str, str, Callable[[], Mapping[str, float]]]]) -> None:
        self._states = states

    def describe(self) -> Iterable[Metric]:
        """No descriptions: gauges are computed on request."""
        return ()

    def collect(self) -> Iterable[Metric]:
        """Each as a gauge."""
        for name, (about, label, values) in self._states.items():
            family = GaugeMetricFamily(name, about, labels=[label])
            try:
                now = values()
            except Exception as error:  # without the database the other figures still count
                log.warning("a figure is unknown", extra={"figure": name, "error": str(error)})
                continue
            for key, value in now.items():
                family.add_metric([key], value)
            yield family


class JsonLines(logging.Formatter):
    """One object per line: time (UTC), level, logger, message, and the fields of `extra`."""

    converter = time.gmtime  # type: ignore[assignment]

    def format(self, record: logging.LogRecord) -> str:
        """The line."""
        line: dict[str, Any] = {
            "time": f"{self.formatTime(record, '%Y-%m-%dT%H:%M:%S')}.{int(record.msecs):03d}Z",
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        line |= {
            k: v
            for k, v in vars(record).items()
            if k not in _STANDARD and k not in ("message", "asctime", "color_message")
        }
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


def log_json() -> None:
    """Write all logs of this process to stderr as lines of JSON."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines())
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=True)
    logging.getLogger("uvicorn.access").disabled = True  # `cosim.service.gate` logs requests
