"""The server of docker/serve.yaml: what it is told the command line understands, and who reaches it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from cosim.cli.main import parser

FILE = Path(__file__).parents[2] / "docker" / "serve.yaml"


def plain(text: object) -> str:
    """With the defaults of its variables."""
    return re.sub(r"\$\{\w+(?::-([^}]*))?\}", lambda found: found[1] or "x", str(text))


def test_a_server_with_two_workers_and_postgresql() -> None:
    services: dict[str, Any] = yaml.safe_load(FILE.read_text())["services"]
    server, database = services["serve"], services["database"]
    args = parser().parse_args([plain(word) for word in server["command"]])
    assert (args.host, args.workers) == ("0.0.0.0", 2)
    assert args.database is None  # a command line shows it to all
    url = plain(server["environment"]["COSIM_DATABASE_URL"])
    assert re.fullmatch(r"postgresql\+psycopg://cosim:.+@database/cosim", url)
    assert [plain(port) for port in server["ports"]] == ["127.0.0.1:8000:8000"]
    assert (server["read_only"], server["cap_drop"]) == (True, ["ALL"])
    assert "ports" not in database
