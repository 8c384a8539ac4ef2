"""`cosim run`: drive one episode of one scenario with one policy."""

from __future__ import annotations

import argparse
import contextlib
import functools
import json
import math
import shlex
import shutil
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.cli import arguments
from cosim.errors import BadInput, SimulationTimeout, extra
from cosim.scenario import Scenario, with_preset
from cosim.scenario.options import EpisodeOptions, of_flags
from cosim.scenario.policy_name import label, read
from cosim.seeding import FIRST_EXAMPLE_SEED
from cosim.types import EpisodeResult
from cosim.workers.worker import Worker

if TYPE_CHECKING:
    from cosim.episode import Progress as Reported
    from cosim.host import Host


DEFAULT_TIMEOUT = 300.0  # s


def add(commands: arguments.SubCommands) -> None:
    """Register the command and its flags."""
    run = commands.add_parser(
        "run",
        help="drive one episode of a scenario",
        description="Drive one episode. Everything after -- goes to SUMO as it stands.",
    )
    run.add_argument(
        "what", metavar="WHAT", help="a scenario's name (cosim scenarios), its folder or any .sumocfg"
    )
    arguments.options(run, without=("scenario",))
    arguments.add(run, "--out")
    arguments.add(run, "--seed", default=FIRST_EXAMPLE_SEED, help=f"default {FIRST_EXAMPLE_SEED}")
    run.add_argument(
        "--beside",
        metavar="POLICY",
        help="drive the same traffic with this policy too, show both side by side",
    )
    run.add_argument("--replay", action="store_true", help="draw DIR/replay.html and DIR/replay.mp4 too")
    arguments.add(run, "--json")
    run.add_argument(
        "--traci-port",
        type=arguments.port,
        metavar="PORT",
        help="let TraCI programs drive with us: SUMO serves them here, and begins when all have connected",
    )
    run.add_argument(
        "--traci-clients", type=arguments.count, metavar="N", help="how many of them (default 1)"
    )
    waits = f"s to wait for them, at the start and in any step (default {DEFAULT_TIMEOUT:g})"
    run.add_argument("--traci-timeout", type=arguments.positive, metavar="S", help=waits)
    run.set_defaults(work=work, passes_on=True)


class Driver:
    """The hosted object of `cosim run`'s worker: loads SUMO and the policy while the caller checks the
    scenario. Raises BadInput for an unknown policy."""

    def __init__(self, policy: str) -> None:
        import cosim.simulation.sumo  # noqa: F401
        from cosim.host import Host
        from cosim.policies import make

        self._make = functools.partial(Host, policy=make(policy))
        self._host: Host | None = None

    def drive(
        self,
        scenario: Scenario,
        case: EpisodeOptions,
        recorded: bool,
        folder: Path | None,
        served: tuple[int, int] | None,
        progress: Reported,
    ) -> tuple[EpisodeResult, Any]:
        """The episode, with its replay data or None; a progress total of 0 s: kernels are being compiled.

        `served`: port of SUMO, number of TraCI programs. Raises as `Host`.
        """
        from cosim.geometry.compiled import on_compilation
        from cosim.host import serving

        on_compilation(functools.cache(lambda: progress(0.0, 0.0)))
        self._host = self._make(
            scenario,
            svo=math.radians(case.svo_deg),
            metrics=case.metrics,
            reward=case.reward,
            simulator=None if served is None else serving(*served),
        )
        if recorded:
            return self._host.run_recorded(case.seed, progress, outputs=case.outputs, folder=folder)
        return self._host.run(case.seed, progress, outputs=case.outputs, folder=folder), None

    def close(self) -> None:
        """End the simulation."""
        if self._host is not None:
            self._host.close()


def work(args: argparse.Namespace) -> int:
    """Drive the episode and the policy of `--beside` in worker processes; show the results."""
    for flag, wanted in (("--output", args.output), ("--replay", args.replay)):
        if wanted and not args.out:
            raise BadInput("needs a run folder to write into: --out DIR", field=flag)
    _check_folder(args.out)
    if args.replay:
        with extra("film", field="--replay"):
            import av  # noqa: F401  # before anything is driven
    served = _served(args)
    cases = [case_of(args)]
    if args.beside is not None:
        cases.append(_beside(args))
    limits = {} if served is None else {"timeout": args.traci_timeout or DEFAULT_TIMEOUT}
    workers = [Worker(Driver, case.policy, name="cosim-run", wait=False, **limits) for case in cases]
    from cosim.files import new_folder
    from cosim.policies import check
    from cosim.scenario import sumo_outputs
    from cosim.scenario.vet import vetted, watched
    from cosim.workers.progress import Progress

    with contextlib.ExitStack() as undone:
        try:
            for case, field in zip(cases, ("--policy", "--beside"), strict=False):
                check(case.policy, field)
            scenarios = [case.scenario(args.sumo_options) for case in cases]
            sumo_outputs.check(cases[0].outputs, scenarios[0].options)
            with Progress(f"{scenarios[0].name}: checking its files", "MB") as checking, watched(checking):
                whole = vetted(scenarios[0])
            scenarios = [replace(whole, preset=scenario.preset) for scenario in scenarios]
            folder = undone.enter_context(new_folder(args.out or None))
            driven = [
                _drive(args, *one, folder, served) for one in zip(workers, cases, scenarios, strict=True)
            ]
        except BaseException:
            for worker in workers:
                worker.kill()  # nothing needs an orderly shutdown
                worker.close()
            raise
    show(args, driven, folder, scenarios[0].mission.kind, cases[0].outputs)
    return 0


def _drive(
    args: argparse.Namespace,
    worker: Worker,
    case: EpisodeOptions,
    scenario: Scenario,
    folder: Path | None,
    served: tuple[int, int] | None,
) -> tuple[EpisodeResult, Any]:
    """One episode with progress; its replay data or None."""
    from cosim.scenario import sumo_outputs
    from cosim.scenario.manifest import TRACI, remembered
    from cosim.workers.progress import Progress

    files = folder / "outputs" if folder is not None and case.outputs else None
    with Progress(f"{scenario.name} {label(case.policy)}", "s") as progress:
        if served is None:
            progress.starting()
        else:
            waiting = f"cosim: SUMO waits for {_programs(served[1])} at port {served[0]}"
            print(waiting, file=sys.stderr, flush=True)
        try:
            result, replay = worker.call(
                "drive", scenario, case, args.replay, files, served, progress=progress
            )
        except BaseException as error:
            worker.kill()
            if served is not None and isinstance(error, SimulationTimeout):
                seconds = args.traci_timeout or DEFAULT_TIMEOUT
                problem = f"{_programs(served[1])} did not connect, or did not step, for {seconds:g} s"
                raise SimulationTimeout(f"port {served[0]}: {problem}") from None
            raise
        finally:
            worker.close()
            if files is not None:  # leftovers of a crashed simulation
                shutil.rmtree(files / sumo_outputs.DRAFT, ignore_errors=True)
    if served is None:
        more = remembered(case, args.sumo_options)
    else:
        more = {TRACI: {"port": served[0], "clients": served[1]}}
    return replace(result, manifest=result.manifest | more), replay


def show(
    args: argparse.Namespace,
    driven: Sequence[tuple[EpisodeResult, Any]],
    folder: Path | None,
    mission: str,
    outputs: Sequence[str] = (),
) -> None:
    """Print the episodes; the first is stored in the run folder, if any, with the data of the replays.
    `mission`: kind of the mission."""
    from cosim.report import result as output
    from cosim.report.episode_text import text
    from cosim.scenario.manifest import CASE

    results, replays = zip(*driven, strict=True)
    said = text(*results, mission=mission, every=bool(args.metric or args.reward))
    if folder is not None:
        output.write_folder(folder, results[0], said, outputs)
        if args.replay:
            from cosim.report.replay.episode import draw

            draw(replays, folder / "replay.html", folder / "replay.mp4")
    if args.json:
        print(json.dumps(results[0].document()))
        return
    print(said)
    if folder is not None:
        print(f"  run folder: {args.out}")
        if CASE in results[0].manifest:
            beside = f" --beside {shlex.quote(args.beside)}" if len(results) > 1 else ""
            print(f"  watch it: cosim replay {shlex.quote(args.out)}{beside}")


def _beside(args: argparse.Namespace) -> EpisodeOptions:
    """The same episode with the policy of `--beside`, without SUMO's output files. Raises BadInput."""
    for flag, given in (("--json", args.json), ("--traci-port", args.traci_port is not None)):
        if given:
            raise BadInput(f"does not go together with {flag}", field="--beside", value=args.beside)
    read(args.beside, field="--beside")
    case = case_of(argparse.Namespace(**vars(args) | {"policy": args.beside, "output": None}))
    if label(case.policy) == label(case_of(args).policy):
        raise BadInput("is the policy that drives already", field="--beside", value=args.beside)
    return case


def _check_folder(out: str | None) -> None:
    """Raises BadInput for a folder with the results of several episodes; an episode's may be replaced."""
    if out is not None and not Path(out, "result.json").exists():
        for name in ("manifest.json", "store.sqlite"):
            if Path(out, name).exists():
                problem = f"holds {name} of several episodes: name another folder"
                raise BadInput(problem, field="--out", value=out)


def _served(args: argparse.Namespace) -> tuple[int, int] | None:
    """SUMO's port and the number of TraCI programs; None without them."""
    if args.traci_port is not None:
        return args.traci_port, args.traci_clients or 1
    for flag, value in (("--traci-clients", args.traci_clients), ("--traci-timeout", args.traci_timeout)):
        if value is not None:
            raise BadInput("needs a port to serve them at: --traci-port PORT", field=flag, value=value)
    return None


def _programs(count: int) -> str:
    return f"{count} TraCI program{'s' * (count > 1)}"


def case_of(args: argparse.Namespace) -> EpisodeOptions:
    """The episode of the flags; files by absolute path, so that a replay finds them."""
    return with_preset(replace(of_flags({**vars(args), "scenario": args.what}), seed=args.seed))
