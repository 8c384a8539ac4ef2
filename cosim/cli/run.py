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
from cosim.errors import BadInput, SimulationTimeout
from cosim.files import code
from cosim.files.xml_input import is_there
from cosim.scenario import Scenario, chosen_preset, human_errors, place
from cosim.scenario.episode_id import EpisodeId
from cosim.scenario.policy_name import label, read
from cosim.seeding import FIRST_TEST_SEED
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
        "what", metavar="WHAT", help="a scenario's name (cosim scenarios), a world's folder or any .sumocfg"
    )
    demands = "by name (default of our worlds: dense), or route files; repeatable"
    arguments.add(run, "--demand", action="append", default=[], help=demands)
    arguments.add(run, "--policy", default="idm")
    arguments.add(run, "--svo", default=45.0)
    arguments.add(run, "--behavior", "--preset", "--duration", "--warmup", "--mission")
    arguments.add(run, "--on-collision", "--errors", "--traffic", "--reward", "--out")
    arguments.add(run, "--driver-model", default="lc2013", help="of the human drivers (default lc2013)")
    arguments.add(run.add_mutually_exclusive_group(), "--av-type", "--av-ids", "--penetration")
    arguments.add(run, "--seed", default=FIRST_TEST_SEED, help=f"default {FIRST_TEST_SEED}")
    outputs = "have SUMO write its NAME output (tripinfo, fcd, ssm, ...) to DIR/outputs; repeatable"
    arguments.add(run, "--output", action="append", default=[], help=outputs)
    arguments.add(run, "--metric", action="append", default=[])
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
    """What `cosim run` hosts in its worker: loads SUMO and the policy at once, while the caller still checks
    the scenario. Raises BadInput for an unknown policy."""

    def __init__(self, policy: str) -> None:
        import cosim.simulation.sumo  # noqa: F401
        from cosim.host import Host
        from cosim.policies import make

        self._make = functools.partial(Host, policy=make(policy))
        self._host: Host | None = None

    def drive(
        self,
        scenario: Scenario,
        case: EpisodeId,
        recorded: bool,
        folder: Path | None,
        served: tuple[int, int] | None,
        progress: Reported,
    ) -> tuple[EpisodeResult, Any]:
        """The episode, with its replay data or None; progress of 0 s in all: kernels are being compiled.

        `served`: the port at which SUMO serves so many TraCI programs. Raises as `Host`.
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
    """Drive it in a worker process, show the result."""
    for flag, wanted in (("--output", args.output), ("--replay", args.replay)):
        if wanted and not args.out:
            raise BadInput("needs a run folder to write into: --out DIR", field=flag)
    served = _served(args)
    case = case_of(args)
    limits = {} if served is None else {"timeout": args.traci_timeout or DEFAULT_TIMEOUT}
    worker = Worker(Driver, case.policy, name="cosim-run", wait=False, **limits)
    from cosim.files import new_folder
    from cosim.policies import check
    from cosim.scenario import sumo_outputs
    from cosim.scenario.manifest import TRACI, remembered
    from cosim.scenario.vet import vetted, watched
    from cosim.workers.progress import Progress

    with contextlib.ExitStack() as undone:
        try:
            check(case.policy)
            scenario = case.scenario(args.sumo_options)
            sumo_outputs.check(case.outputs, scenario.options)
            with Progress(f"{scenario.name}: checking its files", "MB") as checking, watched(checking):
                scenario = vetted(scenario)
            folder = undone.enter_context(new_folder(args.out or None))
        except BaseException:
            worker.kill()  # it is still loading, and has nothing to put away
            worker.close()
            raise
        files = folder / "outputs" if folder is not None and case.outputs else None
        progress = Progress(f"{scenario.name} {label(case.policy)}", "s")
        if served is None:
            progress.starting()
        else:
            print(
                f"cosim: SUMO waits for {_programs(served[1])} at port {served[0]}",
                file=sys.stderr,
                flush=True,
            )
        try:
            result, replay = worker.call(
                "drive", scenario, case, args.replay, files, served, progress=progress
            )
        except BaseException as error:
            worker.kill()
            if served is not None and isinstance(error, SimulationTimeout):
                problem = (
                    f"{_programs(served[1])} did not connect, or did not step, for {limits['timeout']:g} s"
                )
                raise SimulationTimeout(f"port {served[0]}: {problem}") from None
            raise
        finally:
            worker.close()
            if files is not None:  # what a simulation that crashed leaves behind
                shutil.rmtree(files / sumo_outputs.DRAFT, ignore_errors=True)
            progress.done()
    if served is None:
        beside = remembered(case, args.sumo_options)
    else:
        beside = {TRACI: {"port": served[0], "clients": served[1]}}
    result = replace(result, manifest=result.manifest | beside)
    show(args, result, replay, folder, case.outputs)
    return 0


def show(
    args: argparse.Namespace,
    result: EpisodeResult,
    replay: Any,
    folder: Path | None,
    outputs: Sequence[str] = (),
) -> None:
    """Keep the result, and what a `replay` draws, in the run folder, where there is one; print it."""
    from cosim.report import result as output
    from cosim.scenario.manifest import CASE

    if folder is not None:
        output.write_folder(folder, result, outputs)
        if replay is not None:
            from cosim.report.replay.episode import draw

            draw([replay], folder / "replay.html", folder / "replay.mp4")
    if args.json:
        print(json.dumps(result.document()))
    else:
        print(output.table(result, first=not (args.metric or args.reward)))  # else every figure
        if folder is not None:
            again = f" (cosim replay {shlex.quote(args.out)} draws it)" if CASE in result.manifest else ""
            print(f"  run folder               {folder}{again}")


def _served(args: argparse.Namespace) -> tuple[int, int] | None:
    """The port at which SUMO serves so many TraCI programs; None: it drives alone."""
    if args.traci_port is not None:
        return args.traci_port, args.traci_clients or 1
    for flag, value in (("--traci-clients", args.traci_clients), ("--traci-timeout", args.traci_timeout)):
        if value is not None:
            raise BadInput("needs a port to serve them at: --traci-port PORT", field=flag, value=value)
    return None


def _programs(count: int) -> str:
    return f"{count} TraCI program{'s' * (count > 1)}"


def case_of(args: argparse.Namespace) -> EpisodeId:
    """The episode that the flags describe; files by absolute path, so that it can be found again."""
    same = ["behavior", "driver_model", "penetration", "av_type", "av_ids", "duration", "seed"]
    same += ["warmup", "mission", "on_collision", "traffic"]
    what, policy = place(args.what), read(args.policy).text
    return EpisodeId(
        what=what,
        demand=tuple(map(_demand, args.demand)),
        policy=policy,
        preset=chosen_preset(what, policy, args.preset),
        svo_deg=args.svo,
        outputs=tuple(dict.fromkeys(args.output)),
        metrics=tuple(code.absolute(metric, "--metric") for metric in args.metric),
        reward=args.reward and code.absolute(args.reward, "--reward"),
        errors=human_errors.asked(args.errors),
        **{name: getattr(args, name) for name in same},
    )


def _demand(name: str) -> str:
    """A file's absolute path; a demand's name, and whatever is wrong, as it is."""
    is_file = ("." in name or "/" in name) and is_there(Path(name))
    return str(Path(name).absolute()) if is_file else name
