"""The result pages that no driven episodes make, each rebuilt in small."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import measured

IN_MAKE_TEST = ("law",)


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=page.name, marks=() if page.name in IN_MAKE_TEST else pytest.mark.soak)
        for page in measured.PAGES
    ],
)
def test_every_measured_page_is_rebuilt_and_not_measured_twice(
    page: measured.Page, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = measured.Place(tmp_path / "pages", tmp_path / "work", small=True)
    assert measured.make(page, place)
    for file in page.files:
        assert (place.out / file).stat().st_size > 200
    assert (place.out / page.files[0]).read_text().startswith("# ")
    monkeypatch.setattr(measured.subprocess, "run", lambda *_, **__: pytest.fail("measured twice"))
    assert not measured.make(page, place)
    (place.out / page.files[0]).unlink()
    with pytest.raises(pytest.fail.Exception, match="measured twice"):
        measured.make(page, place)
