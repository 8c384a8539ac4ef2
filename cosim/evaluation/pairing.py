"""Which episode of A belongs to which of B: the same traffic, driven by another policy or another version.

A pair is one episode of each side that agree in all of `PAIR` and in the seed; a group is the pairs that
agree in `PAIR`. Nothing is pooled over groups.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosim.errors import BadInput
from cosim.evaluation import run_folder, wording
from cosim.evaluation.figures import Row
from cosim.evaluation.run_folder import Run
from cosim.evaluation.summary import GROUP, not_comparable
from cosim.evaluation.tasks import BAD_INPUT, OK
from cosim.sumocfg import hint

PAIR = tuple(name for name in GROUP if name != "policy")
ACROSS = ("behavior", "penetration", "preset", "svo_deg", "driver_model")  # what A and B may differ in


@dataclass(frozen=True, slots=True)
class Side:
    """One of the two: a run, or one policy of it."""

    run: Run
    policy: str | None = None


@dataclass(frozen=True)
class Group:
    """The pairs of one cell."""

    identity: dict[str, Any]  # PAIR, and "a" and "b": who drove
    name: str
    pairs: list[tuple[Row, Row]]  # both ok, by seed
    failed: list[Row]  # sim_crash and timeout among the pairs
    refused: list[Row]  # bad_input among the pairs
    unpaired: tuple[int, int]  # episodes of A and of B without a partner
    known: dict[str, Measure]
    seed: int  # of the bootstrap

    @cached_property
    def figures(self) -> dict[str, PairedFigure]:
        """Every measure by name."""
        return {name: paired(measure, self.pairs, self.seed) for name, measure in self.known.items()}

    @property
    def not_comparable(self) -> int:
        """Pairs in which either episode says that it must not be compared."""
        return sum(not_comparable(a) or not_comparable(b) for a, b in self.pairs)

    @property
    def identical(self) -> int:
        """Pairs in which both drove exactly alike."""
        return sum(a.get("trace_hash") == b.get("trace_hash") for a, b in self.pairs)

    def check(self, threshold: Threshold) -> Check:
        """Hold one threshold against the group."""
        status, message = _judge(threshold, self)
        return Check(threshold, self.name, status, message)


def side(text: str) -> Side:
    """`DIR` or `DIR:POLICY`.

    Raises:
        BadInput: no such run, or no such policy in it.
    """
    folder, _, policy = text.rpartition(":")
    if Path(text).is_dir() or not folder:
        return Side(run_folder.read(text))
    return chosen(run_folder.read(folder), policy)


def chosen(run: Run, policy: str) -> Side:
    """One policy of a run. Raises BadInput when it is not in it."""
    if policy not in run.policies:
        near = hint(policy, run.policies)
        raise BadInput(f"no episode of this policy in {run.path}{near}", field="policy", value=policy)
    return Side(run, policy)


def _title(one: Side) -> str:
    return str(one.run.path) if one.policy is None else f"{one.run.path}:{one.policy}"


def _pair(
    a: Side, b: Side, across: tuple[str, ...], known: dict[str, Measure], seed: int
) -> tuple[list[Group], tuple[list[str], list[str]]]:
    """Groups of pairs in A's order, and the names of the cells that only one side has."""
    by_policy = _clear_policies(a, b)
    if by_policy:
        common = set(a.run.policies) & set(b.run.policies)
        if not common:
            problem = f"no policy in common: A has {_words(a.run.policies)}, B has {_words(b.run.policies)}"
            raise BadInput(problem + "; choose with DIR:POLICY")
    fields = tuple(name for name in PAIR if name not in across) + (("policy",) if by_policy else ())
    same_folder = a.run.path.resolve() == b.run.path.resolve()
    cells_a, cells_b = (_cells(one, fields, across, same_folder) for one in (a, b))
    groups = []
    for key, rows_a in cells_a.items():
        rows_b = cells_b.get(key, {})
        seeds = sorted(rows_a.keys() & rows_b.keys())
        if seeds:
            pairs = [(rows_a[s], rows_b[s]) for s in seeds]
            groups.append(_group(pairs, fields, (len(rows_a), len(rows_b)), known, seed))
    if not groups:
        raise BadInput(_why_none(cells_a, cells_b, fields))
    alone = tuple(
        [_name(next(iter(rows.values())), fields) for key, rows in mine.items() if key not in others]
        for mine, others in ((cells_a, cells_b), (cells_b, cells_a))
    )
    return groups, (alone[0], alone[1])


def _clear_policies(a: Side, b: Side) -> bool:
    """Whether each policy is paired with itself; otherwise each side is of one policy."""
    several = [one.policy is None and len(one.run.policies) > 1 for one in (a, b)]
    if not any(several):
        return False
    if a.policy is None and b.policy is None and all(several):
        return True
    name, one = ("A", a) if several[0] else ("B", b)
    problem = f"{name} holds several policies, choose one with DIR:POLICY: {_words(one.run.policies)}"
    raise BadInput(problem, value=str(one.run.path))


def _cells(
    one: Side, fields: tuple[str, ...], across: tuple[str, ...], same_folder: bool
) -> dict[_Key, dict[int, Row]]:
    """Rows by pairing key and seed. Raises BadInput when two rows would be the same partner."""
    found: dict[_Key, dict[int, Row]] = {}
    for row in one.run.rows:
        if one.policy is not None and row["policy"] != one.policy:
            continue
        key: _Key = tuple(row.get(name) for name in fields)
        if same_folder:  # then files can be told apart even where their names are equal
            case = {k: v for k, v in one.run.case(row).items() if k not in (*across, "outputs")}
            key += (json.dumps(case, sort_keys=True),)
        rows = found.setdefault(key, {})
        twin = rows.get(row["seed"])
        if twin is not None:
            problem = (
                f"two cells would be one, {twin['cell']} and {row['cell']}: both are {_name(row, fields)}"
                f" with seed {row['seed']}"
            )
            raise BadInput(problem, file=one.run.path)
        rows[row["seed"]] = row
    return found


def _group(
    pairs: list[tuple[Row, Row]],
    fields: tuple[str, ...],
    episodes: tuple[int, int],
    known: dict[str, Measure],
    seed: int,
) -> Group:
    first_a, first_b = pairs[0]
    identity = {name: first_a.get(name) for name in fields if name != "policy"}
    differing = [n for n in PAIR if n not in fields and first_a.get(n) != first_b.get(n)]
    for letter, row in (("a", first_a), ("b", first_b)):
        identity[letter] = {"policy": row["policy"], "policy_label": row.get("policy_label") or ""}
        identity[letter] |= {n: row.get(n) for n in differing}
    name = f"{wording.group(identity)}: {_who(identity['a'])} -> {_who(identity['b'])}"
    wrong = [row for pair in pairs for row in pair if row["status"] != OK]
    return Group(
        identity=identity,
        name=name,
        pairs=[(x, y) for x, y in pairs if x["status"] == OK and y["status"] == OK],
        failed=[row for row in wrong if row["status"] != BAD_INPUT],
        refused=[row for row in wrong if row["status"] == BAD_INPUT],
        unpaired=(episodes[0] - len(pairs), episodes[1] - len(pairs)),
        known=known,
        seed=seed,
    )


def _who(one: dict[str, Any]) -> str:
    """`vfn-p (untrained) svo_deg=45.0`"""
    label = f" ({one['policy_label']})" if one["policy_label"] else ""
    others = [f" {k}={v}" for k, v in one.items() if k not in ("policy", "policy_label")]
    return one["policy"] + label + "".join(others)


def _name(row: Row, fields: tuple[str, ...]) -> str:
    return wording.group({name: row.get(name) for name in (*fields, "policy")})


def _why_none(a: dict[_Key, dict[int, Row]], b: dict[_Key, dict[int, Row]], fields: tuple[str, ...]) -> str:
    """Why nothing could be paired, in one sentence."""
    if a.keys() & b.keys():
        seeds = [sorted(seed for rows in cells.values() for seed in rows) for cells in (a, b)]
        spans = [f"{s[0]} to {s[-1]}" for s in seeds]
        return f"A and B have no seed in common: A has {spans[0]}, B has {spans[1]}"
    for k, name in enumerate(fields):
        has = [{key[k] for key in cells} for cells in (a, b)]
        if not has[0] & has[1]:
            way = f" (--across {name} compares them all the same)" if name in ACROSS else ""
            return (
                f"A and B have nothing in common: {name} is {_words(has[0])} in A, {_words(has[1])} in B{way}"
            )
    return "A and B have no cell in common: no " + " x ".join(fields) + " is in both"


def _words(values: Iterable[Any]) -> str:
    return ", ".join("none" if v is None else str(v) for v in values) or "none"
