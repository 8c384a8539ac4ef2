"""How a policy may be named, and what is said of a name that is none."""

from __future__ import annotations

from pathlib import Path

import pytest

from cosim.errors import BadInput
from cosim.scenario.policy_name import PolicyName, label, read


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a run, weights and code, in which one stands."""
    (tmp_path / "runs" / "a=b c").mkdir(parents=True)
    for name in ("runs/a=b c/best.safetensors", "runs/old.safetensors", "mine.py", "idm.py"):
        (tmp_path / name).touch()
    (tmp_path / "empty").mkdir()
    (tmp_path / "idm").mkdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("idm", PolicyName("idm")),  # ships, whatever folder has this name
        ("no-such", PolicyName("no-such")),  # `cosim.policies` refuses it
        ("vfn-p, 25 m#0a1b", PolicyName("vfn-p, 25 m#0a1b")),
        ("runs/a=b c", PolicyName("a-b-c", "runs/a=b c/best.safetensors")),
        ("runs/a=b c/best.safetensors", PolicyName("a-b-c", "runs/a=b c/best.safetensors")),
        ("new=runs/a=b c", PolicyName("new", "runs/a=b c/best.safetensors")),
        ("runs/old.safetensors", PolicyName("old", "runs/old.safetensors")),
        ("mine.py:Agent", PolicyName("Agent", "mine.py", "Agent")),
        ("x-1=./mine.py:make", PolicyName("x-1", "mine.py", "make")),
    ],
)
def test_a_name_is_read_and_reads_back_from_anywhere(
    here: Path, text: str, found: PolicyName, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = found._replace(place=str(here / found.place) if found.place else "")
    name = read(text)
    assert name == found
    monkeypatch.chdir("/")
    assert read(text, here) == found
    assert read(name.text) == found
    assert label(name.text) == found.label


def test_a_module_is_no_file() -> None:
    assert read("mine=my.agents:Best") == PolicyName("mine", "my.agents", "Best")
    assert read("my.agents:Best").text == "Best=my.agents:Best"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("mine.py", "name the class or function in it: mine.py:NAME"),
        ("mine.py:", "the name of a class, factory or function is needed"),
        ("mine.py:a-b", "the name of a class, factory"),
        ("my label=runs/old.safetensors", "a label has letters, digits"),
        ("runs/none.safetensors", "no such file: /"),
        ("./none", "no such file: /"),
        ("new=none.py:Agent", "no such file: /"),
        ("./empty", "/empty/best.safetensors"),
        ("./mine.py.bak:Agent", "FILE.py:NAME or MODULE:NAME is needed"),
        ("new=mine.py", "name the class or function in it"),
    ],
)
def test_what_is_wrong_with_a_name_is_said(here: Path, text: str, said: str) -> None:
    with pytest.raises(BadInput) as refused:
        read(text)
    assert str(refused.value).startswith(f"--policy={text!r}: ")
    assert said in str(refused.value)
    with pytest.raises(BadInput, match=r"^spec\.yaml: policy="):
        read(text, here, "policy", "spec.yaml")
