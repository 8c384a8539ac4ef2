"""Pairs of episodes of A and B: the same traffic under another policy or another version.

The two episodes of a pair agree in `PAIR`, in `SETTINGS` and in the seed. A group has the pairs that agree in
`PAIR`. Nothing is pooled over groups.
"""

import itertools
import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosim.errors import BadInput, hint
from cosim.report import run_folder, wording
from cosim.report.figures import Row
from cosim.report.run_folder import SETTINGS, Run
from cosim.report.summary import GROUP, mission_guessed, not_comparable
from cosim.workers.tasks import BAD_INPUT, OK

# Figures of the mission vehicle.
MISSION_COLUMNS = frozenset({"mission_success", "mission_failed_at_end", "mission_time_s", "dt_mission_m"})
PAIR = tuple(name for name in GROUP if name != "policy")
ACROSS = tuple(name for name in PAIR if name not in ("scenario", "demand"))  # may differ


@dataclass(frozen=True, slots=True)
class Side:
    """A or B of a comparison: a run, or one policy of it."""

    run: Run
    policy: str | None = None


@dataclass(frozen=True)
class Group:
    """The pairs of one cell."""

    identity: dict[str, Any]  # by the names of `PAIR`
    a: dict[str, Any]  # the driver: policy, policy_label, and the options in which A and B differ
    b: dict[str, Any]
    pairs: list[tuple[Row, Row]]  # both ok, by seed
    failed: list[Row]  # paired episodes of status sim_crash or timeout
    refused: list[Row]  # paired episodes of status bad_input
    unpaired: tuple[int, int]  # episodes of A and of B without a partner

    @property
    def name(self) -> str:
        """`merge / contested / ... / lc2013: idm -> altruist-rule`"""
        return f"{wording.group(self.identity)}: {driver(self.a)} -> {driver(self.b)}"

    @property
    def not_comparable(self) -> int:
        """Pairs with an episode that is marked as not comparable."""
        return sum(not_comparable(a) or not_comparable(b) for a, b in self.pairs)

    @property
    def mission_guessed(self) -> int:
        """Pairs in which either episode's mission vehicle was guessed."""
        return sum(mission_guessed(a) or mission_guessed(b) for a, b in self.pairs)

    @property
    def errors_begun(self) -> tuple[int, int, int]:
        """Human errors in A, in B and in both (`errors_begun`)."""
        return errors_begun(self.pairs)

    @property
    def identical(self) -> int:
        """Pairs with equal trace hashes."""
        return sum(a.get("trace_hash") == b.get("trace_hash") for a, b in self.pairs)


def errors_begun(pairs: Iterable[tuple[Row, Row]]) -> tuple[int, int, int]:
    """Human errors that began in A's episodes, in B's, and in both: of equal kind, vehicle and second."""
    begun = [[Counter(map(tuple, _errors(row))) for row in pair] for pair in pairs]
    return (
        sum(a.total() for a, _ in begun),
        sum(b.total() for _, b in begun),
        sum((a & b).total() for a, b in begun),
    )


def side(text: str) -> Side:
    """Read `DIR` or `DIR:POLICY`; an unfinished run has its driven episodes.

    Raises:
        BadInput: no such run, or no such policy in it.
    """
    folder, _, policy = text.rpartition(":")
    if Path(text).is_dir() or not folder:
        return Side(run_folder.read(text, unfinished=True))
    return chosen(run_folder.read(folder, unfinished=True), policy)


def chosen(run: Run, policy: str) -> Side:
    """One policy of a run. Raises BadInput when the run has no episode of it."""
    if policy not in run.policies:
        near = hint(policy, run.policies)
        raise BadInput(f"no episode of this policy in {run.path}{near}", field="policy", value=policy)
    return Side(run, policy)


def title(side: Side) -> str:
    """`DIR` or `DIR:POLICY`."""
    return str(side.run.path) if side.policy is None else f"{side.run.path}:{side.policy}"


def driver(identity: Mapping[str, Any]) -> str:
    """`vfn-p (untrained) svo_deg=45.0`, of `Group.a` or `Group.b`."""
    label = f" ({identity['policy_label']})" if identity["policy_label"] else ""
    options = [f" {k}={v}" for k, v in identity.items() if k not in ("policy", "policy_label")]
    return str(identity["policy"]) + label + "".join(options)


def pair(a: Side, b: Side, across: Sequence[str] = ()) -> tuple[list[Group], tuple[list[str], list[str]]]:
    """Groups of pairs in A's order, and the names of cells that only A or only B has.

    `across`: names of `ACROSS` in which A and B may differ.

    Raises:
        BadInput: nothing to pair, no common seed, several policies on one side and one on the other, two
            cells with the same key.
    """
    for name in across:
        if name not in ACROSS:
            raise BadInput(f"cannot be compared across{hint(name, ACROSS)}", field="--across", value=name)
    by_policy = _paired_by_policy(a, b)
    if by_policy and not set(a.run.policies) & set(b.run.policies):
        problem = f"no policy in common: A has {_words(a.run.policies)}, B has {_words(b.run.policies)}"
        raise BadInput(problem + "; choose with DIR:POLICY")
    fields = tuple(name for name in PAIR if name not in across) + ("policy",) * by_policy
    same_folder = a.run.path.resolve() == b.run.path.resolve()
    settings_known = not same_folder and all(side.run.manifest.get("cells") for side in (a, b))
    settings = SETTINGS if settings_known else ()
    all_a, all_b = (_cells(side, fields, across, same_folder, settings) for side in (a, b))
    groups = []
    for key, cells_a in all_a.items():
        for rows_a, rows_b in itertools.product(cells_a.values(), all_b.get(key, {}).values()):
            if pairs := [(rows_a[s], rows_b[s]) for s in sorted(rows_a.keys() & rows_b.keys())]:
                groups.append(_group(pairs, fields, (len(rows_a), len(rows_b))))
    if not groups:
        raise BadInput(_why_none(all_a, all_b, fields + settings))
    only_a, only_b = (
        [
            _name(next(iter(rows.values())))
            for key, cells in of_side.items()
            for rows in cells.values()
            if not any(rows.keys() & others.keys() for others in of_other.get(key, {}).values())
        ]
        for of_side, of_other in ((all_a, all_b), (all_b, all_a))
    )
    return groups, (only_a, only_b)


# ---- inside ----


def _errors(row: Row) -> list[list[Any]]:
    """`human_error_list` of an episode; [] where it has none."""
    errors = row.get("human_error_list") or []
    return list(json.loads(errors) if isinstance(errors, str) else errors)


_Key = tuple[Any, ...]


def _paired_by_policy(a: Side, b: Side) -> bool:
    """Whether each policy is paired with itself; otherwise each side has one policy.

    Raises BadInput when one side has several policies, and the other has one.
    """
    several = [side.policy is None and len(side.run.policies) > 1 for side in (a, b)]
    if all(several) or not any(several):
        return all(several)
    name, side = ("A", a) if several[0] else ("B", b)
    problem = f"{name} holds several policies, choose one with DIR:POLICY: {_words(side.run.policies)}"
    raise BadInput(problem, value=str(side.run.path))


_Cells = dict[_Key, dict[_Key, dict[int, Row]]]


def _cells(
    side: Side,
    fields: tuple[str, ...],
    across: Sequence[str],
    same_folder: bool,
    settings: tuple[str, ...],
) -> _Cells:
    """Rows by pairing key (`fields`, then `settings`), then by the values of `across`, then by seed.

    Raises BadInput when two rows have the same key.
    """
    cells: _Cells = {}
    for row in side.run.rows:
        if side.policy is not None and row["policy"] != side.policy:
            continue
        driven = side.run.settings(row) if settings else {}
        key: _Key = (*(row.get(name) for name in fields), *(driven[name] for name in settings))
        if (
            same_folder
        ):  # a run may have different files of equal names: the requested options distinguish them
            case = {k: v for k, v in side.run.case(row).items() if k not in (*across, "outputs")}
            key += (json.dumps(case, sort_keys=True),)
        rows = cells.setdefault(key, {}).setdefault(tuple(row.get(name) for name in across), {})
        twin = rows.setdefault(row["seed"], row)
        if twin is not row:
            problem = f"two cells would be one, {twin['cell']} and {row['cell']}: both are {_name(row)}"
            raise BadInput(f"{problem} with seed {row['seed']}", file=side.run.path)
    return cells


def _group(pairs: list[tuple[Row, Row]], fields: tuple[str, ...], episodes: tuple[int, int]) -> Group:
    first, second = pairs[0]
    differing = [n for n in PAIR if n not in fields and first.get(n) != second.get(n)]
    drivers = [
        {
            "policy": row["policy"],
            "policy_label": next((p[k]["policy_label"] for p in pairs if p[k].get("policy_label")), ""),
            **{name: row.get(name) for name in differing},
        }
        for k, row in enumerate(pairs[0])
    ]
    without_figures = [row for pair in pairs for row in pair if row["status"] != OK]
    return Group(
        identity={n: first.get(n) for n in PAIR if n not in differing},
        a=drivers[0],
        b=drivers[1],
        pairs=[_same_mission(x, y) for x, y in pairs if x["status"] == OK and y["status"] == OK],
        failed=[row for row in without_figures if row["status"] != BAD_INPUT],
        refused=[row for row in without_figures if row["status"] == BAD_INPUT],
        unpaired=(episodes[0] - len(pairs), episodes[1] - len(pairs)),
    )


def _same_mission(*pair: Row) -> tuple[Row, Row]:
    """The pair; without the figures of the mission vehicle where the guessed vehicles differ."""
    a, b = pair
    if a.get("mission_vehicle") != b.get("mission_vehicle") and any(map(mission_guessed, pair)):
        nothing = dict.fromkeys(MISSION_COLUMNS)
        return {**a, **nothing}, {**b, **nothing}
    return a, b


def _name(row: Row) -> str:
    return wording.group({name: row.get(name) for name in GROUP})


def _why_none(a: _Cells, b: _Cells, fields: tuple[str, ...]) -> str:
    """The reason why nothing could be paired, in one sentence."""
    if common := a.keys() & b.keys():
        spans = []
        for cells in (a, b):
            seeds = [seed for key in common for rows in cells[key].values() for seed in rows]
            spans.append(f"{min(seeds)} to {max(seeds)}")
        return f"A and B have no seed in common: A has {spans[0]}, B has {spans[1]}"
    for k, name in enumerate(fields):
        has = [{key[k] for key in cells} for cells in (a, b)]
        if not has[0] & has[1]:
            way = f" (--across {name} compares them anyway)" if name in ACROSS else ""
            return (
                f"A and B have nothing in common: {name} is {_words(has[0])} in A, {_words(has[1])} in B{way}"
            )
    return "A and B have no cell in common: no " + " x ".join(fields) + " is in both"


def _words(values: Iterable[Any]) -> str:
    return ", ".join(sorted("none" if v is None else str(v) for v in values)) or "none"
