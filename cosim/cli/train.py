"""`cosim train`: train one of the networks; `--resume` continues an interrupted training exactly."""

import argparse

from cosim.cli import arguments
from cosim.errors import BadInput, extra
from cosim.policies import TRAINABLE

WHAT = (*TRAINABLE, "altruist", "hpn", "encoder")
VARIANTS = ("hpn", "hpn-no-history", "hpn-plain")
DEFAULTS = {"config": "papers", "device": "cpu", "threads": 1, "variant": "hpn"}
OF_HPN = "recordings", "validation", "variant"
OF_AGENTS = "reward", "metric", "errors"
UNUSED = {  # flags that a training does not read, if not `OF_HPN`
    "altruist": ("config", "scenario", *OF_AGENTS, "device", "threads", *OF_HPN),
    "encoder": ("iterations", *OF_AGENTS, *OF_HPN),
    "hpn": ("scenario", "iterations", *OF_AGENTS),
}


def add(commands: arguments.SubCommands) -> None:
    """Register the command and its flags."""
    train = commands.add_parser(
        "train",
        help="train one of the papers' agents, our own, or the predictor",
        description="Train a network. The folder --out then holds log.jsonl, tensorboard/, best and last "
        "weights with their configuration, and everything that --resume needs.",
    )
    train.add_argument("what", choices=WHAT, help="which network")
    train.add_argument("--config", metavar="FILE", help="papers (default), paper, smoke, or a YAML file")
    train.add_argument(
        "--scenario",
        action="append",
        default=[],
        metavar="NAME",
        help="a scenario, its folder, or all (default: the file's)",
    )
    arguments.add(train, "--reward", help="learn from this: p, t, or your own (default: the file's)")
    arguments.add(train, "--metric", action="append", default=[])
    arguments.add(train, "--errors")
    train.add_argument("--iterations", type=arguments.count, metavar="N", help="instead of the file's")
    arguments.add(train, "--seed", help="of everything; instead of the file's")
    arguments.add(train, "--resume")
    train.add_argument("--device", choices=("cpu", "cuda"))
    arguments.add(train, "--workers", default=1, help="driving processes")
    train.add_argument("--threads", type=arguments.count, metavar="N", help="of the learner")
    recorded = train.add_argument_group("hpn", "learns from recordings (cosim record)")
    recorded.add_argument("--recordings", action="append", default=[], metavar="DIR", help="training seeds")
    recorded.add_argument("--validation", action="append", default=[], metavar="DIR", help="tuning seeds")
    recorded.add_argument("--variant", choices=VARIANTS, help="hpn is the one that ships")
    arguments.add(train, "--out", required=True)
    train.set_defaults(work=work, **DEFAULTS)


def work(args: argparse.Namespace) -> int:
    """Train until the last iteration. Raises BadInput for a flag that this training does not read."""
    for flag in UNUSED.get(args.what, OF_HPN):
        value = getattr(args, flag)
        if value and value != DEFAULTS.get(flag):
            raise BadInput(f"does not apply to {args.what}", field=f"--{flag}", value=value)
    with extra("train", field="train", value=args.what):
        import tensorboard  # noqa: F401  # before anything is driven
    if args.what == "hpn":
        from cosim.learning.train_hpn import train

        return train(args)
    if args.what == "altruist":
        with extra("train", field="train", value=args.what):
            from cosim.learning.train_altruist import train

        return train(args)
    if args.what == "encoder":
        from cosim.learning.train_encoder import train

        return train(args)
    from cosim.learning.train_vfn import train

    return train(args)
