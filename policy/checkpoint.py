"""Network weights on disk: safetensors and a JSON card beside it. Nothing is ever unpickled.

`NAME.safetensors` holds the tensors. `NAME.json` describes them: the networks' configurations, the SHA-256
of the tensor file, the training data and the measured result.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import MISSING, asdict, fields, is_dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import nn

from cosim.errors import BadInput, WeightsMismatch
from cosim.files import read_json, whole

FORMAT = "cosim-weights-1"
SHIPPED = Path(__file__).parent / "weights"


def save(
    path: Path,
    networks: Mapping[str, nn.Module],
    configs: Mapping[str, Any],
    measured: Mapping[str, Any] | None = None,
    data: Mapping[str, Any] | None = None,
) -> None:
    """Write `path` (.safetensors) and its card. `networks`: name -> module, e.g. vfn, hpn.

    configs: name -> frozen dataclass; measured: the result on validation episodes; data: the data manifest.
    """
    tensors = {
        f"{name}.{key}": value.detach().to("cpu").contiguous()
        for name, network in networks.items()
        for key, value in network.state_dict().items()
    }
    with whole(path) as draft:
        save_file(tensors, draft, metadata={"format": FORMAT})
        card = {
            "format": FORMAT,
            "sha256": sha256(draft),
            "configs": {name: asdict(c) if is_dataclass(c) else c for name, c in configs.items()},  # type: ignore[arg-type]
            "measured": dict(measured or {}),
            "data": dict(data or {}),
        }
        with whole(path.with_suffix(".json")) as text:  # the card first: weights never lack their card
            text.write_text(json.dumps(card, indent=2, sort_keys=True) + "\n")


def read_card(path: Path) -> dict[str, Any]:
    """The card of `path`, after checking that it belongs to the file. Raises BadInput, WeightsMismatch."""
    card_file = path.with_suffix(".json")
    for needed in (path, card_file):
        if not needed.is_file():
            raise BadInput("missing weights file", file=needed)
    card = read_json(card_file)
    if card.get("format") != FORMAT:
        raise WeightsMismatch(f"not a card of format {FORMAT}", file=card_file)
    if card.get("sha256") != sha256(path):
        raise WeightsMismatch("its SHA-256 is not the one on its card", file=path, field="sha256")
    return card


def load(path: Path, networks: Mapping[str, nn.Module], configs: Mapping[str, Any]) -> dict[str, Any]:
    """Fill `networks` from `path` and return the card.

    Raises WeightsMismatch, with the networks untouched, when the hash, a configuration, or a tensor's name,
    shape or type does not match the networks, or when a value is not finite.
    """
    card = read_card(path)
    for name, config in configs.items():
        wanted, stated = plain(config), card.get("configs", {}).get(name)
        if isinstance(stated, dict):
            stated = _filled(stated, _defaults(config))
        if stated != wanted:
            differs = [k for k in wanted if not isinstance(stated, dict) or stated.get(k) != wanted[k]]
            raise WeightsMismatch(
                f"made for another layout (differs in {', '.join(differs) or 'its fields'})",
                file=path,
                field=f"configs.{name}",
            )
    states = {name: network.state_dict() for name, network in networks.items()}
    expected = {f"{name}.{key}": value for name, state in states.items() for key, value in state.items()}
    try:
        with safe_open(path, framework="pt", device="cpu") as file:
            found = set(file.keys())
            for problem, names in (("missing", set(expected) - found), ("unknown", found - set(expected))):
                if names:
                    raise WeightsMismatch(f"{len(names)} tensors are {problem}", file=path, field=min(names))
            for key, value in expected.items():
                shape = tuple(file.get_slice(key).get_shape())
                if shape != tuple(value.shape):
                    raise WeightsMismatch(
                        f"has shape {shape}, the network needs {tuple(value.shape)}", file=path, field=key
                    )
            loaded = {key: file.get_tensor(key) for key in expected}
    except SafetensorError as error:
        raise WeightsMismatch(f"not a safetensors file: {error}", file=path) from None
    for key, tensor in loaded.items():
        if tensor.dtype != expected[key].dtype:
            raise WeightsMismatch(
                f"is {tensor.dtype}, the network needs {expected[key].dtype}", file=path, field=key
            )
        if not bool(torch.isfinite(tensor).all()):
            raise WeightsMismatch("holds values that are not finite", file=path, field=key)
    for name, network in networks.items():
        network.load_state_dict({key: loaded[f"{name}.{key}"] for key in states[name]})
    return card


def sha256(path: Path) -> str:
    """Hash of a file's content."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def plain(config: Any) -> Any:
    """A configuration as JSON data."""
    return json.loads(json.dumps(asdict(config) if is_dataclass(config) else config))  # type: ignore[arg-type]


def _defaults(config: Any) -> dict[str, Any]:
    """The default values of a configuration's fields, as JSON data."""
    if not is_dataclass(config):
        return {}
    made = {f.name: f.default_factory() for f in fields(config) if f.default_factory is not MISSING}
    made |= {f.name: f.default for f in fields(config) if f.default is not MISSING}
    return {name: plain(value) for name, value in made.items()}


def _filled(found: dict[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """A stored configuration, completed with defaults of newer options (the default of a new option must keep
    the earlier behaviour)."""
    both = [k for k, v in found.items() if isinstance(v, dict) and isinstance(defaults.get(k), dict)]
    return {**defaults, **found, **{k: _filled(found[k], defaults[k]) for k in both}}
