"""What docs/guides/extending.md says of Gymnasium's vectors, Stable-Baselines3 and TorchRL, line by line."""

from __future__ import annotations

import re
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "docs" / "guides" / "extending.md"


def documented(word: str) -> str:
    """The page's Python that holds `word`."""
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    (found,) = [block for block in blocks if word in block]
    return str(found)


def run(code: str, folder: Path) -> None:
    """A user's file of these lines; its simulations are processes that import it again."""
    file = folder / "user.py"
    file.write_text(f'if __name__ == "__main__":\n{textwrap.indent(code, "    ")}')
    command = [sys.executable, "-W", "ignore", str(file)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_gymnasium_drives_several_at_once(mode: str, tmp_path: Path) -> None:
    code = documented("make_vec(").replace('"async"', f'"{mode}"')
    run(
        code
        + "assert seen.shape == (2, 148)\n"
        + "assert (seen[0] != seen[1]).any(), 'each has a seed of its own'\n"
        + "assert not (terminated | truncated).any()\n"
        + "assert (info['reward_terms']['total'] == rewards).all()\n",
        tmp_path,
    )


@pytest.mark.parametrize("kind", [pytest.param("SubprocVecEnv", marks=pytest.mark.soak), "DummyVecEnv"])
def test_stable_baselines_learns_in_several_at_once(kind: str, tmp_path: Path) -> None:
    code = documented("make_vec_env(").replace("SubprocVecEnv", kind)
    run(code + f"assert type(envs).__name__ == '{kind}'\nassert model.num_timesteps == 64\n", tmp_path)


def test_torchrl_rolls_out_all_avs(tmp_path: Path) -> None:
    """Of 16 agents some wait for their AVs to depart; the rollout ends with the episode, of 6 s."""
    code = documented("PettingZooWrapper(").replace('"contested"', '"contested", duration=6.0')
    run(
        code
        + "acting, seen = rollout['av', 'mask'], rollout['av', 'observation']\n"
        + "assert len(rollout) == 15 and rollout['next', 'done'][-1]\n"
        + "waits = (seen == 0).all(-1)\n"
        + "assert 0 < waits[0].sum() and not waits[0].all()\n"
        + "masks, actions = rollout['av', 'action_mask'], rollout['av', 'action']\n"
        + "assert (actions[acting & waits] == 1).all(), 'who waits idles'\n"
        + "assert masks[acting].gather(-1, actions[acting][:, None]).all()\n"
        + "assert (rollout['next', 'av', 'reward'][acting & waits] == 0).all()\n"
        + "assert (rollout['next', 'av', 'reward'][acting & ~waits] != 0).any()\n",
        tmp_path,
    )
