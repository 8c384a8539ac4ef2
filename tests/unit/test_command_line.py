"""A word that no command takes is answered with the nearest that there is."""

import pytest

from cosim.cli.main import main


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("run merge --polcy idm", "--polcy: cosim run has no such flag, did you mean '--policy'?"),
        (
            "evaluate --scenarios=merge",
            "--scenarios: cosim evaluate has no such flag, did you mean '--scenario'?",
        ),
        ("run --scenario merge", "--scenario: is given without a flag: cosim run NAME"),
        ("run merge exit", "argument='exit': is one word too many for cosim run"),
    ],
)
def test_unknown_words(words: str, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words.split()) == 2
    assert said in capsys.readouterr().err
