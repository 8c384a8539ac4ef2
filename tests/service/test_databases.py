"""Servers on one PostgreSQL: one drives, however connections come and go; a database of another version."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa

from cosim.batch.store import Store
from cosim.cli.main import main
from cosim.errors import BadInput
from cosim.service.jobs import Jobs
from tests.service.postgres import Postgres, needed, until
from tests.service.servers import Server

SHORT: dict[str, Any] = {"scenario": "merge", "demand": "contested", "duration": 2, "warmup": 1}
SEEDS = range(140_000, 140_008)


@pytest.fixture(scope="module")
def postgres() -> Iterator[Postgres]:
    with Postgres() as running:
        yield running


@pytest.fixture(scope="module")
def undisturbed(server: Server) -> dict[int, str]:
    """Seed -> trace hash, where nothing goes wrong."""
    run = server.submit(**SHORT, seeds=f"{SEEDS.start}:{SEEDS.stop}")
    assert server.wait(run)["status"] == "finished"
    return server.hashes(run)


def driven(server: Server, runs: dict[int, str]) -> dict[int, str]:
    """The hashes of runs of a seed each; every run has finished and has one row."""
    found: dict[int, str] = {}
    for seed, run in runs.items():
        ended = server.wait(run)
        assert ended["status"] == "finished", ended
        hashes = server.hashes(run)
        assert [*hashes] == [seed]
        found |= hashes
    return found


def ready(server: Server) -> bool:
    return bool(server.http.get("/ready").json()["ready"])


def submitted(server: Server) -> dict[int, str]:
    return {seed: server.submit(**SHORT, seeds=f"{seed}:{seed + 1}") for seed in SEEDS}


@needed
def test_a_database_that_goes_and_comes_back_costs_nothing(
    postgres: Postgres, undisturbed: dict[int, str], tmp_path: Path
) -> None:
    with Server(tmp_path / "a", "--workers", "2", COSIM_DATABASE_URL=postgres.url("one")) as server:
        runs = submitted(server)
        server.wait(runs[SEEDS[1]])
        postgres.stop()
        until(lambda: "database" in server.http.get("/ready").json()["problems"])
        assert server.http.get("/health").json()["status"] == "ok"
        assert server.http.get(f"/api/runs/{runs[SEEDS[0]]}").status_code == 503
        figures = server.http.get("/metrics")
        assert (figures.status_code, "cosim_workers{" in figures.text) == (200, True)
        assert "cosim_runs{" not in figures.text
        postgres.start()
        until(lambda: ready(server))
        assert driven(server, runs) == undisturbed


@needed
@pytest.mark.soak
def test_two_servers_on_one_database_drive_every_run_once(
    postgres: Postgres, undisturbed: dict[int, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    urls = {name: postgres.url(name) for name in ("first", "second")}
    file = tmp_path / "url"
    file.write_text(urls["second"] + "\n")
    with Server(tmp_path / "a", "--workers", "2", COSIM_DATABASE_URL=urls["first"]) as first:
        runs = submitted(first)
        first.wait(runs[SEEDS[0]])
        postgres.drop("first")  # and nobody else is there: it goes on
        first.wait(runs[SEEDS[2]])
        until(lambda: postgres.sql("SELECT pid FROM pg_locks WHERE locktype = 'advisory'").strip())
        flags = ["--data", str(tmp_path / "c"), "--port", "0", "--database-file", str(file)]
        assert main(["serve", *flags]) == 2
        assert "another server is working in it" in capsys.readouterr().err
        postgres.sql("ALTER ROLE first NOLOGIN")
        postgres.drop("first")  # it cannot come back at once
        with Server(tmp_path / "b", "--workers", "2", "--database-file", str(file)) as second:
            postgres.sql("ALTER ROLE first LOGIN")
            until(
                lambda: first.http.get("/ready").json()["problems"].get("database", "").startswith("another")
            )
            assert first.http.post("/api/runs", json=SHORT).status_code == 503
            assert driven(second, runs) == undisturbed
            more = second.submit(**SHORT, seeds=f"{SEEDS[0]}:{SEEDS[0] + 20}")
            second.wait(more, "running")
            second.kill()
        until(lambda: ready(first))
        assert first.wait(more)["status"] == "finished"
        rows = first.http.get(f"/api/runs/{more}/rows").json()["rows"]
        assert [row["seed"] for row in rows] == [*range(SEEDS[0], SEEDS[0] + 20)]
        assert undisturbed.items() <= {row["seed"]: row["trace_hash"] for row in rows}.items()


@pytest.mark.parametrize(("version", "age"), [(0, "an older"), (2, "a newer")])
def test_tables_of_another_version_are_refused(tmp_path: Path, version: int, age: str) -> None:
    for make, part in ((Jobs, "runs"), (Store, "rows")):
        url = f"sqlite:///{tmp_path / part}.sqlite"
        make(url).close()
        make(url).close()
        with sa.create_engine(url).begin() as connection:
            connection.execute(sa.text(f"UPDATE cosim_schemas SET version = {version}"))
        with pytest.raises(BadInput, match=f"{age} cosim: version {version}, this cosim needs 1"):
            make(url)


def test_a_server_whose_database_is_of_another_version_does_not_start(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "data").mkdir()
    url = f"sqlite:///{tmp_path / 'data' / 'service.sqlite'}"
    Jobs(url).close()
    with sa.create_engine(url).begin() as connection:
        connection.execute(sa.text("UPDATE cosim_schemas SET version = 7"))
    assert main(["serve", "--data", str(tmp_path / "data"), "--port", "0"]) == 2
    assert "a newer cosim: version 7" in capsys.readouterr().err


def test_a_database_is_named_once_and_its_password_is_never_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "url"
    file.write_text("postgresql://me:secret@127.0.0.1:1/x")
    here = ["serve", "--data", str(tmp_path / "data"), "--port", "0"]
    assert main([*here, "--database-file", str(file), "--database", "sqlite://"]) == 2
    assert "excludes --database" in capsys.readouterr().err
    assert main([*here, "--database-file", str(tmp_path / "none")]) == 2
    assert "cannot read: no such file" in capsys.readouterr().err
    for text in ("postgresql+psycopg://me:secret@127.0.0.1:1/x", "me://me:secret@x"):
        monkeypatch.setenv("COSIM_DATABASE_URL", text)
        assert main(here) == 2
        said = capsys.readouterr().err
        assert "--database" in said
        assert "secret" not in said
