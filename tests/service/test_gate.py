"""Who may ask: a token unless bound to loopback, this origin only; figures and logs."""

from __future__ import annotations

from pathlib import Path

import pytest

from cosim.cli.main import main
from tests.service.servers import Server

SECRET = "a-secret-of-the-tests"


def test_pages_of_other_origins_and_other_names_are_refused(server: Server) -> None:
    assert server.http.get("/api/runs", headers={"Origin": "http://evil.example"}).status_code == 403
    assert server.http.get("/api/runs", headers={"Origin": "http://["}).status_code == 403
    assert server.http.get("/api/runs", headers={"Host": "evil.example"}).status_code == 403
    assert server.http.get("/api/runs", headers={"Origin": server.url}).status_code == 200


def test_a_token_is_asked_for_and_never_logged(tmp_path: Path) -> None:
    with Server(tmp_path / "data", "--host", "0.0.0.0", COSIM_TOKEN=SECRET) as server:
        assert server.http.get("/health").status_code == 200
        assert server.http.get("/api/runs").status_code == 401
        assert server.http.get("/metrics", headers={"Authorization": "Bearer wrong"}).status_code == 401
        given = {"Authorization": f"Bearer {SECRET}"}
        assert server.http.get("/api/runs", headers=given).status_code == 200
        assert server.http.get("/api/runs", params={"policy": SECRET}, headers=given).status_code == 200
    assert SECRET not in server.log.read_text()


def test_a_token_is_made_where_none_is_given(tmp_path: Path) -> None:
    with Server(tmp_path / "data", "--host", "0.0.0.0", COSIM_TOKEN="") as server:
        file = tmp_path / "data" / "token"
        assert str(file) in server.log.read_text()
        assert file.stat().st_mode & 0o077 == 0
        given = {"Authorization": f"Bearer {file.read_text().strip()}"}
        assert server.http.get("/api/runs", headers=given).status_code == 200
    assert file.read_text().strip() not in server.log.read_text()


def test_figures_are_prometheus_and_logs_are_json(server: Server) -> None:
    server.http.get("/api/catalogue")
    figures = server.http.get("/metrics").text
    assert 'cosim_http_requests_total{method="GET",route="/api/catalogue",status="200"}' in figures
    assert 'cosim_workers{state="idle"}' in figures
    noted = {"path": "/api/catalogue", "status": 200}.items()
    assert any(noted <= line.items() for line in server.said() if line["message"] == "request")


def test_a_server_that_cannot_start_says_why(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with Server(tmp_path / "data") as server:
        port = server.url.rpartition(":")[2]
        assert main(["serve", "--data", str(tmp_path / "data"), "--port", "0"]) == 2
        assert "another server is working in it" in capsys.readouterr().err
        assert main(["serve", "--data", str(tmp_path / "other"), "--port", port]) == 2
        assert f"--port={port}: cannot listen there: address already in use" in capsys.readouterr().err
    assert server.process.returncode == 0  # ended by SIGTERM, in order
    assert main(["serve", "--data", str(tmp_path / "x"), "--port", "0", "--database", "nonsense"]) == 2
    assert "--database='nonsense': is no database URL" in capsys.readouterr().err
