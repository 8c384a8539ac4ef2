"""`cosim run`: drive one episode of one scenario with one policy."""

from __future__ import annotations

import argparse
import json
import math
import shlex
import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.cli import arguments
from cosim.errors import BadInput
from cosim.files.xml_input import is_there
from cosim.scenario import BEHAVIORS, place
from cosim.scenario.behaviors import DRIVER_MODELS
from cosim.scenario.episode_id import Case
from cosim.scenario.policy_name import label, read
from cosim.seeding import FIRST_TEST_SEED
from cosim.types import Preset

if TYPE_CHECKING:
    from cosim.episode import Progress
    from cosim.scenario import Scenario
    from cosim.workers.worker import Worker


def add(verbs: arguments.Verbs) -> None:
    """Register the verb and its flags."""
    run = verbs.add_parser(
        "run",
        help="drive one episode of a scenario",
        description="Drive one episode. Everything after -- goes to SUMO as it stands.",
    )
    run.add_argument(
        "what", metavar="WHAT", help="a scenario's name (cosim scenarios), a world's folder or any .sumocfg"
    )
    run.add_argument(
        "--demand",
        action="append",
        default=[],
        metavar="NAME|FILE",
        help="demand by name (default of our worlds: dense), or route files",
    )
    run.add_argument("--policy", default="idm", metavar="POLICY", help=arguments.POLICY)
    run.add_argument(
        "--svo", type=arguments.degrees, default=45.0, metavar="DEG", help="SVO angle, 0..90 (default 45)"
    )
    run.add_argument(
        "--behavior",
        choices=BEHAVIORS,
        help="Table II class of the human drivers (default: mixed; contested: moderate; your files: as-is)",
    )
    run.add_argument("--driver-model", choices=DRIVER_MODELS, default="lc2013", help="default lc2013")
    run.add_argument("--preset", choices=Preset.ALL, help="who guards the AVs (default: the scenario's)")
    fleet = run.add_mutually_exclusive_group()
    fleet.add_argument("--av-type", metavar="T", help="AVs are the vehicles of this vType")
    fleet.add_argument("--av-ids", metavar="REGEX", help="AVs are the vehicles whose id matches")
    fleet.add_argument(
        "--penetration", type=arguments.share, metavar="P", help="this share of vehicles are AVs, 0..1"
    )
    run.add_argument(
        "--seed", type=arguments.seed, default=FIRST_TEST_SEED, metavar="N", help=f"default {FIRST_TEST_SEED}"
    )
    run.add_argument(
        "--duration", type=arguments.positive, metavar="S", help="counted s (default: the scenario's)"
    )
    run.add_argument("--out", metavar="DIR", help="write the run folder here")
    run.add_argument(
        "--output",
        action="append",
        default=[],
        metavar="NAME",
        help="have SUMO write its NAME output (tripinfo, fcd, ssm, ...) to DIR/outputs; repeatable",
    )
    run.add_argument("--replay", action="store_true", help="draw DIR/replay.html and DIR/replay.mp4 too")
    run.add_argument("--json", action="store_true", help="print exactly one JSON document on stdout")
    run.set_defaults(work=work, passes_on=True)


class Driver:
    """What `cosim run` hosts in its worker: loads SUMO and the policy at once, while the caller still checks
    the scenario. Raises BadInput for an unknown policy."""

    def __init__(self, policy: str) -> None:
        from cosim.host import Host
        from cosim.policies import make
        from cosim.simulation import sumo

        self._host_type, self._simulation = Host, sumo
        self._policy = make(policy)
        self._driven: Host | None = None

    def drive(
        self, verb: str, scenario: Scenario, svo: float, seed: int, progress: Progress, **options: Any
    ) -> Any:
        """`Host.run` or `Host.watch`; progress of 0 s in all: a kernel is being compiled.

        Raises as `Host`.
        """
        from cosim.geometry.compiled import on_compilation

        on_compilation(lambda: progress(0.0, 0.0))
        self._driven = self._host_type(scenario, self._policy, svo)
        return getattr(self._driven, verb)(seed, progress, **options)

    def close(self) -> None:
        """End the simulation."""
        if self._driven is not None:
            self._driven.close()


def work(args: argparse.Namespace) -> int:
    """Drive it in a worker process, show the result."""
    from cosim.workers.worker import Worker

    for flag, wanted in (("--output", args.output), ("--replay", args.replay)):
        if wanted and not args.out:
            raise BadInput("needs a run folder to write into: --out DIR", field=flag)
    case = case_of(args)
    with Worker(Driver, case.policy, name="cosim-run", wait=False) as worker:
        return _drive(args, case, worker)


def _drive(args: argparse.Namespace, case: Case, worker: Worker) -> int:
    """The worker is loading meanwhile, and is not waited for when something is wrong."""
    from cosim.files import prepare_folder
    from cosim.policies import check
    from cosim.report import result as output
    from cosim.scenario import sumo_outputs
    from cosim.scenario.manifest import remembered
    from cosim.scenario.vet import vetted
    from cosim.workers.progress import Progress

    try:
        check(case.policy)
        scenario = case.scenario(args.sumo_options)
        sumo_outputs.check(case.outputs, scenario.options)
        scenario = vetted(scenario)
        new = bool(args.out) and not Path(args.out).exists()
        folder = prepare_folder(args.out) if args.out else None
    except BaseException:
        worker.kill()
        raise
    files = folder / "outputs" if folder is not None and case.outputs else None
    progress = Progress(f"{scenario.name} {label(case.policy)}", "s")
    progress.starting()

    def shown(done: float, total: float) -> None:
        if total:
            progress(done, total)
        else:
            progress.compiling()

    try:
        verb, svo = "watch" if args.replay else "run", math.radians(case.svo_deg)
        options = {"progress": shown, "outputs": case.outputs, "folder": files}
        answer = worker.call("drive", verb, scenario, svo, case.seed, **options)
        result, watched = answer if args.replay else (answer, None)
    except BaseException:
        if new and folder is not None:
            shutil.rmtree(folder, ignore_errors=True)
        raise
    finally:
        if files is not None:  # what a simulation that died leaves behind
            shutil.rmtree(files / sumo_outputs.DRAFT, ignore_errors=True)
        progress.done()
    result = replace(result, manifest=result.manifest | remembered(case, args.sumo_options))
    if folder is not None:
        output.write_folder(folder, result, case.outputs)
        if watched is not None:
            from cosim.report.replay.episode import draw

            draw([watched], folder / "replay.html", folder / "replay.mp4")
    if args.json:
        print(json.dumps(result.document()))
    else:
        print(output.table(result))
        if folder is not None:
            print(f"  run folder               {folder} (cosim replay {shlex.quote(args.out)} draws it)")
    return 0


def case_of(args: argparse.Namespace) -> Case:
    """The episode that the flags describe; files by absolute path, so that it can be found again."""
    return Case(
        what=place(args.what),
        demand=tuple(map(_demand, args.demand)),
        policy=read(args.policy).text,
        behavior=args.behavior,
        driver_model=args.driver_model,
        penetration=args.penetration,
        av_type=args.av_type,
        av_ids=args.av_ids,
        svo_deg=args.svo,
        preset=args.preset,
        duration=args.duration,
        seed=args.seed,
        outputs=tuple(dict.fromkeys(args.output)),
    )


def _demand(name: str) -> str:
    """A file's absolute path; a demand's name, and whatever is wrong, as it is."""
    is_file = ("." in name or "/" in name) and is_there(Path(name))
    return str(Path(name).absolute()) if is_file else name
