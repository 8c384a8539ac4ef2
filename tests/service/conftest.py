"""One server for all tests that leave it as they found it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.service.servers import Server


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """`cosim serve` with two workers, without a token."""
    data: Path = tmp_path_factory.mktemp("service") / "data"
    with Server(data, "--workers", "2") as running:
        yield running
