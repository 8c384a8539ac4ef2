"""`cosim replay`: drive a recorded episode again, check that it is equal, draw it as a page and a film."""

import argparse
import sys
from pathlib import Path

from cosim.cli import arguments
from cosim.errors import extra
from cosim.scenario.policy_name import label


def add(commands: arguments.SubCommands) -> None:
    """Register the command and its flags."""
    replay = commands.add_parser(
        "replay",
        help="draw an episode of a run as an interactive page and a film",
        description="Drive an episode again from its manifest, compare the trace hash (exit code 1 if it "
        "differs), and draw the episode: an HTML page that needs no network, and an MP4. With --beside the "
        "film shows another policy in the same traffic, one above the other.",
    )
    replay.add_argument("run", metavar="RUN", help="folder of `cosim run --out` or of `cosim evaluate`")
    replay.add_argument(
        "episode", nargs="?", metavar="EPISODE", help="its key, or its seed where only one episode has it"
    )
    arguments.texts(
        replay,
        {
            "--html": ("FILE", "the page (default: replay*.html in RUN)"),
            "--mp4": ("FILE", "the film (default: replay*.mp4 in RUN)"),
            "--gif": ("FILE", "a small animation, for a page or a slide"),
            "--beside": ("POLICY", "drive the same traffic with this policy too, film both"),
            "--follow": ("ID", "the vehicle that the film follows (default: the mission vehicle)"),
        },
    )
    replay.add_argument("--no-check", action="store_true", help="draw it even if the trace hash differs")
    replay.set_defaults(work=work)


def work(args: argparse.Namespace) -> int:
    """Check, drive, compare, draw. With named output files only those are drawn."""
    from cosim.report.replay import episode as replay

    recorded = replay.find(Path(args.run), args.episode)
    scenario, warnings = replay.check_inputs(recorded)
    for warning in warnings:
        print(f"cosim: warning: {warning}", file=sys.stderr)
    other = None if args.beside is None else replay.beside(recorded, args.beside)
    html, mp4, gif = (None if name is None else Path(name) for name in (args.html, args.mp4, args.gif))
    if html is None and mp4 is None and gif is None:
        name = recorded.name if other is None else f"{recorded.name}-beside-{label(other.case.policy)}"
        mp4 = recorded.folder / f"{name}.mp4"
        html = recorded.folder / f"{name}.html" if other is None else None
    if film := mp4 or gif:
        with extra("film", field="--mp4" if mp4 else "--gif", value=str(film)):
            import av  # noqa: F401  # before anything is driven
    result, recording = replay.drive(recorded, scenario, check=not args.no_check)
    others = [] if other is None else [replay.drive(other, scenario, check=False)[1]]
    replay.draw([recording, *others], html, mp4, gif, args.follow)
    same = "the same episode" if result.trace_hash == recorded.trace_hash else "ANOTHER episode"
    print(f"{same}: trace hash {result.trace_hash}")
    for path in filter(None, (html, mp4, gif)):
        print(f"{path} ({path.stat().st_size / 1e6:.2f} MB)")
    return 0
