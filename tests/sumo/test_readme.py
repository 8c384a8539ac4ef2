"""What the README shows is what a reader gets: its Python snippet runs as it stands."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from cosim.envs.view import View
from cosim.types import MetaAction

README = Path(__file__).parents[2] / "README.md"


def test_the_python_snippet_drives_a_whole_episode(capsys: pytest.CaptureFixture[str]) -> None:
    (snippet,) = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    seen: list[View] = []

    def my_agent(view: View) -> MetaAction:
        seen.append(view)
        return MetaAction.DECELERATE if len(seen) % 2 else MetaAction.IDLE

    exec(compile(snippet, "README.md", "exec"), {"my_agent": my_agent})
    assert seen, "the agent was asked"
    printed = capsys.readouterr().out
    assert "EpisodeResult(scenario='merge', demand='contested', policy='external'" in printed
    assert "seed=200000" in printed
