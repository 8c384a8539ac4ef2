"""One reader from YAML to frozen dataclasses: types, bounds, defaults, and errors that name the place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Annotated, Literal

import pytest

from cosim.errors import BadInput, Range
from cosim.files.yaml_input import NonNegative, read


class Gear(IntEnum):
    PARK = 0
    DRIVE = 1


@dataclass(frozen=True)
class Wheel:
    radius: NonNegative
    name: str = ""

    def __post_init__(self) -> None:
        if self.radius > 2.0:
            raise BadInput("is too large", field="radius", value=self.radius)


@dataclass(frozen=True)
class Car:
    wheels: tuple[Wheel, ...] = ()
    names: tuple[str, ...] = ("a",)
    size: tuple[int, int] = (1, 2)
    share: Annotated[float, Range(0.0, high=1.0)] | None = 0.5
    gear: Gear = Gear.PARK
    fuel: Literal["petrol", "diesel"] = "petrol"
    seats: int = 4
    open: bool = False
    spare: Wheel = Wheel(0.3)
    axles: Mapping[str, Wheel] | None = None


def of(folder: Path, text: str) -> Car:
    file = folder / "car.yaml"
    file.write_text(text)
    return read(file, Car)


def test_every_kind_of_field_is_read(tmp_path: Path) -> None:
    text = (
        "wheels: [{radius: 1}, {radius: 0, name: b}]\nnames: [x, y]\nsize: [3, 4]\nshare: 1\ngear: 1\n"
        "fuel: diesel\nseats: 2\nopen: true\nspare: {radius: 0.5}\naxles: {front: {radius: 2}}\n"
    )
    wheels = (Wheel(1.0), Wheel(0.0, "b"))
    axles = {"front": Wheel(2.0)}
    whole = Car(wheels, ("x", "y"), (3, 4), 1.0, Gear.DRIVE, "diesel", 2, True, Wheel(0.5), axles)
    assert of(tmp_path, text) == whole


def test_an_empty_field_is_absent_unless_nothing_is_one_of_its_values(tmp_path: Path) -> None:
    assert of(tmp_path, "names:\nshare:\n") == Car(share=None)
    assert of(tmp_path, "") == Car()


def test_one_value_stands_for_a_list_of_one(tmp_path: Path) -> None:
    assert of(tmp_path, "names: x\nwheels: {radius: 1}") == Car(names=("x",), wheels=(Wheel(1.0),))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("wheel: 3", "wheel=3: unknown field, did you mean 'wheels'?"),
        ("wheels: [{radius: 1}, 3]", "wheels[1]=3: a mapping is needed"),
        ("wheels: [{radius: 1}, {radius: -1}]", "wheels[1].radius=-1: must be at least 0"),
        ("wheels: [{radius: 3}]", "wheels[0].radius=3.0: is too large"),
        ("wheels: [{name: b}]", "wheels[0].radius: is missing"),
        ("names: [x, 3]", "names=3: text is needed"),
        ("names: 3", "names=3: text is needed, or a list"),
        ("size: [1]", "size=[1]: a list of 2 values is needed"),
        ("size: 1", "size=1: a list of 2 values is needed"),
        ("share: 1.5", "share=1.5: a number from 0 to 1 is needed"),
        ("share: true", "share=True: a number from 0 to 1 is needed"),
        ("gear: 2", "gear=2: must be one of 0 park, 1 drive"),
        ("fuel: diesle", "fuel='diesle': must be one of petrol, diesel, did you mean 'diesel'?"),
        ("seats: 2.5", "seats=2.5: a whole number is needed"),
        ("seats: true", "seats=True: a whole number is needed"),
        ("open: 1", "open=1: true or false is needed"),
        ("spare: {radius: .inf}", "spare.radius=inf: must be finite"),
        ("axles: {front: {radius: much}}", "axles.front.radius='much': a finite number is needed"),
        ("axles: 3", "axles=3: a mapping is needed"),
        ("- 1", "file=[1]: a mapping is needed"),
    ],
)
def test_what_is_wrong_is_named_with_file_field_and_value(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(BadInput) as refused:
        of(tmp_path, text)
    assert str(refused.value).endswith(f"car.yaml: {said}")
