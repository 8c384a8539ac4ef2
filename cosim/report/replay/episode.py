"""`cosim replay`: find an episode in a run folder, drive it again, check that it is the same, and draw it."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cosim.errors import BadInput, CosimError, hint
from cosim.files import cannot, read_json, whole
from cosim.host import Host
from cosim.policies import check
from cosim.recording.replay_data import ReplayData
from cosim.report import run_folder
from cosim.scenario import Scenario
from cosim.scenario.manifest import CASE, OPTIONS, POLICY_FILES, TRACI, checked, manifest, named
from cosim.scenario.options import EpisodeOptions
from cosim.scenario.policy_name import label, read
from cosim.scenario.sumocfg import keeps
from cosim.scenario.vet import vetted
from cosim.types import EpisodeResult
from cosim.workers.progress import Progress
from cosim.workers.tasks import OK
from cosim.workers.worker import Worker

MANIFEST = "manifest.json"
ABSENT = "no such file: a folder of cosim run --out or cosim evaluate is needed"
MAX_NAMED = 8  # episodes of one seed


class ReplayDiffers(CosimError):
    """The replay differs from the recorded episode: exit code 1, as for a failed threshold."""

    exit_code = 1


@dataclass(frozen=True)
class Recorded:
    """One episode of a run folder."""

    case: EpisodeOptions
    options: tuple[str, ...]  # SUMO's own, as typed after `--`
    manifest: Mapping[str, Any]
    trace_hash: str
    folder: Path

    @property
    def name(self) -> str:
        """The name of the drawn files, without suffix."""
        return f"replay-{self.case.key}" if (self.folder / "episodes.parquet").exists() else "replay"


def find(folder: Path, episode: str | None) -> Recorded:
    """The episode in a folder of `cosim run --out` (`episode` may be None) or of `cosim evaluate`.

    `episode`: the key, or the seed if only one episode has it.

    Raises:
        BadInput: no such folder, not a run folder, no such episode (with the nearest key), or an episode that
            was not driven to its end.
    """
    file, result = folder / MANIFEST, folder / "result.json"
    document = checked(read_json(file, ABSENT), file)
    if "cells" in document:
        return _of_batch(folder, episode)
    if TRACI in document:
        problem = "other TraCI clients took part: it cannot be driven again, use --replay with the run itself"
        raise BadInput(problem, file=file)
    if CASE not in document:
        raise BadInput("was not written by this version of cosim run or evaluate", file=file)
    driven = checked(read_json(result, ABSENT), result)
    if "trace_hash" not in driven:
        raise BadInput("is missing", file=result, field="trace_hash")
    recorded = Recorded(
        EpisodeOptions.read(document[CASE], file, CASE),
        tuple(document.get(OPTIONS, ())),
        document,
        driven["trace_hash"],
        folder,
    )
    if episode is not None and episode not in (recorded.case.key, str(recorded.case.seed)):
        problem = f"this folder holds one episode, with seed {recorded.case.seed}"
        raise BadInput(problem, field="EPISODE", value=episode)
    return recorded


def check_inputs(recorded: Recorded) -> tuple[Scenario, list[str]]:
    """The scenario with the recorded files, and warnings about other versions.

    Raises:
        BadInput: a file (named) or a setting of the scenario has changed.
    """
    scenario = vetted(recorded.case.scenario(recorded.options))
    then, now = recorded.manifest, manifest(scenario, recorded.case.seed)
    paths = named(scenario.files)
    driven = then.get("files", {})
    for name, digest in now["files"].items():
        if name not in driven:
            raise BadInput("was not among the files of the recorded run", file=paths[name])
        if driven[name] != digest:
            raise BadInput(_changed("it was driven", driven[name], digest), file=paths[name])
    if gone := driven.keys() - now["files"].keys():
        raise BadInput("belonged to the recorded run, but not to this one", file=min(gone))
    for name in sorted(now.keys() - {"files", "versions", "seed", "options_not_passed_on"}):
        if name in then and (before := _lasting(name, then)) != (here := _lasting(name, now)):
            problem = f"is {here!r} now, it was {before!r} when it was driven"
            raise BadInput(problem, file=recorded.folder / MANIFEST, field=name)
    return scenario, [
        f"driven with {name} {before}, here is {now['versions'].get(name)}: the replay may differ"
        for name, before in then.get("versions", {}).items()
        if name in now["versions"] and now["versions"][name] != before
    ]


def drive(recorded: Recorded, scenario: Scenario, *, check: bool = True) -> tuple[EpisodeResult, ReplayData]:
    """Drive the episode again in its own process, and record it.

    Raises (only with `check`): as `driven`.
    """
    case = recorded.case
    with Progress(f"replay {scenario.name} {label(case.policy)}", "s") as progress:
        progress.starting()
        worker = Worker(Host, scenario, case.policy, math.radians(case.svo_deg), name="cosim-replay")
        with worker:
            return driven(recorded, worker.call, progress, check=check)


def driven(
    recorded: Recorded, call: Callable[..., Any], progress: Callable[..., None], *, check: bool = True
) -> tuple[EpisodeResult, ReplayData]:
    """Drive the episode again on a host, and record it; `call` calls the host's methods by name.

    Raises (only with `check`):
        BadInput: the policy's weights or code have changed.
        ReplayDiffers: the trace hash differs.
    """
    if check:
        _same_policy(recorded.manifest.get(POLICY_FILES, {}), call("policy_files"))
    result, replay = call("run_recorded", recorded.case.seed, progress=progress)
    if check and result.trace_hash != recorded.trace_hash:
        raise ReplayDiffers(
            f"the replay is not the recorded episode: trace hash {result.trace_hash[:16]}... after "
            f"{result.steps} decisions, recorded was {recorded.trace_hash[:16]}... (--no-check draws it "
            "anyway)"
        )
    return result, replay


def beside(recorded: Recorded, policy: str) -> Recorded:
    """The same traffic and seed with another policy, whose trace hash is not checked.

    Raises:
        BadInput: there is no such policy.
    """
    name = read(policy, field="--beside").text
    check(name, "--beside")
    return replace(recorded, case=replace(recorded.case, policy=name))


def draw(
    episodes: Sequence[ReplayData],
    html: Path | None = None,
    mp4: Path | None = None,
    gif: Path | None = None,
    follow: str | None = None,
) -> None:
    """Write the page of the first episode, the film and the GIF of all, each atomically.

    Raises:
        BadInput: `follow` is not a vehicle of the episodes; a file cannot be written.
    """
    names = list(dict.fromkeys(track.id for r in episodes for track in r.tracks))
    if follow is not None and follow not in names:
        raise BadInput(f"no such vehicle{hint(follow, names)}", field="--follow", value=follow)
    for file in filter(None, (html, mp4, gif)):
        with cannot("write", file=file):
            file.parent.mkdir(parents=True, exist_ok=True)
    if html is not None:
        from cosim.report.replay.page import page

        with cannot("write", file=html), whole(html) as draft:
            draft.write_text(page(episodes[0]), "utf-8")
    if mp4 is not None or gif is not None:
        from cosim.report.replay import video

        for path, make in ((mp4, video.film), (gif, video.animation)):
            if path is not None:
                with Progress(path.name, "pictures") as progress, cannot("write", file=path):
                    make(episodes, path, follow=follow, progress=progress)


def _of_batch(folder: Path, episode: str | None) -> Recorded:
    run = run_folder.read(folder)
    if episode is None:
        raise BadInput(f"holds {len(run.rows)} episodes: name one by its key or seed", file=folder)
    found = [r for r in run.rows if r["key"] == episode] or [r for r in run.rows if str(r["seed"]) == episode]
    if not found:
        raise BadInput(
            f"no such episode{hint(episode, [row['key'] for row in run.rows])}",
            field="EPISODE",
            value=episode,
        )
    if len(found) > 1:
        some = [f"{r['key']} ({r['scenario']} / {r['demand']} / {r['policy']})" for r in found[:MAX_NAMED]]
        some += ["..."] * (len(found) > MAX_NAMED)
        problem = f"{len(found)} episodes have this seed: {', '.join(some)}"
        raise BadInput(problem, field="EPISODE", value=episode)
    row = found[0]
    if row["status"] != OK:
        problem = f"was not driven to its end (status {row['status']}): nothing to compare with"
        raise BadInput(problem, field="EPISODE", value=row["key"])
    file, where = folder / MANIFEST, f"cells.{row['cell']}"
    cell = run.manifest["cells"].get(row["cell"], {})
    for part in (CASE, "manifest"):
        if part not in cell:
            raise BadInput("is missing", file=file, field=f"{where}.{part}")
    case = EpisodeOptions.read({**cell[CASE], "seed": row["seed"]}, file, f"{where}.{CASE}")
    return Recorded(case, (), cell["manifest"], row["trace_hash"], folder)


def _same_policy(then: Mapping[str, str], now: Mapping[str, str]) -> None:
    """Raises BadInput when weights or code differ from those of the episode."""
    for name, before in then.items():
        if name in now and now[name] != before:
            raise BadInput(_changed("it drove", before, now[name]), file=name)


def _changed(since: str, before: str, now: str) -> str:
    return f"has changed since {since} (SHA-256 {before[:12]}..., now {now[:12]}...)"


def _lasting(name: str, document: Mapping[str, Any]) -> Any:
    """A setting of a manifest; of SUMO's options only those that a replay uses again."""
    value = document[name]
    return {k: v for k, v in value.items() if keeps(k)} if name == "sumo_options" else value
