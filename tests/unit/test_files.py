"""Files that cannot be read or written are one clear error; JSON documents are objects."""

from __future__ import annotations

from pathlib import Path

import pytest

from cosim.errors import BadInput
from cosim.files import cannot, prepare_folder, read_json, working_in


def test_an_error_of_the_system_names_what_was_being_done_and_where(tmp_path: Path) -> None:
    with pytest.raises(BadInput) as refused, cannot("write", file="a.csv", field="--out", value="x"):
        (tmp_path / "gone" / "a.csv").write_text("")
    assert str(refused.value) == "a.csv: --out='x': cannot write: no such file or directory"


def test_other_errors_pass() -> None:
    with pytest.raises(ZeroDivisionError), cannot("write"):
        1 / 0  # noqa: B018


def test_a_run_folder_below_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInput, match=r"--out=.*: cannot make this folder: not a directory"):
        prepare_folder(str(tmp_path / "file" / "run"))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b'{"a": 1', "not JSON: "),
        (b"[1]", "not a JSON object"),
        (b'"no such file"', "not a JSON object"),
        (b"\xff{}", "not JSON: "),
        (None, "no such file"),
    ],
)
def test_what_is_no_json_object_is_refused_with_its_file(
    tmp_path: Path, content: bytes | None, said: str
) -> None:
    file = tmp_path / "a.json"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(BadInput) as refused:
        read_json(file)
    assert str(refused.value).startswith(f"{file}: {said}")


def test_a_folder_in_the_place_of_a_document_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="cannot read: is a directory"):
        read_json(tmp_path)


def test_what_is_absent_is_said_in_the_callers_words(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="a run of cosim is needed"):
        read_json(tmp_path / "a.json", "a run of cosim is needed")


def test_one_process_at_a_time_works_in_a_folder(tmp_path: Path) -> None:
    run = str(tmp_path / "run")
    with (
        working_in(run),
        pytest.raises(BadInput, match="another process is working in it"),
        working_in(run),
    ):
        raise AssertionError("two at a time")
    with working_in(run):
        pass
