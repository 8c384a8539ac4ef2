"""What the README shows is what a reader gets: its Python snippets run as they stand."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from cosim.observation.view import View
from cosim.types import MetaAction

README = Path(__file__).parents[2] / "README.md"


def test_the_python_snippet_drives_a_whole_episode(capsys: pytest.CaptureFixture[str]) -> None:
    snippet, _ = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    seen: list[View] = []

    def my_agent(view: View) -> MetaAction:
        seen.append(view)
        return MetaAction.DECELERATE if len(seen) % 2 else MetaAction.IDLE

    exec(compile(snippet, "README.md", "exec"), {"my_agent": my_agent})
    assert seen, "the agent was asked"
    printed = capsys.readouterr().out
    assert "EpisodeResult(scenario='merge', demand='contested', policy='external'" in printed
    assert "seed=200000" in printed


def test_the_snippet_of_both_learning_faces_drives_too() -> None:
    _, snippet = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    seen: dict[str, Any] = {}
    exec(compile(snippet, "README.md", "exec"), seen)
    assert seen["env"].agents == []
    assert all(truncated or seen["terminated"][a] for a, truncated in seen["truncated"].items())
