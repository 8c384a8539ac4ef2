"""`cosim train`: train one of the networks; `--resume` continues an interrupted training exactly."""

import argparse

from cosim.cli import arguments
from cosim.errors import extra
from cosim.policies import TRAINABLE

WHAT = (*TRAINABLE, "altruist", "hpn", "encoder")
VARIANTS = ("hpn", "hpn-no-history", "hpn-plain")


def add(commands: arguments.SubCommands) -> None:
    """Register the command and its flags."""
    train = commands.add_parser(
        "train",
        help="train one of the papers' agents, our own, or the predictor",
        description="Train a network. The folder --out then holds log.jsonl, tensorboard/, best and last "
        "weights with their configuration, and everything that --resume needs.",
    )
    train.add_argument("what", choices=WHAT, help="which network")
    train.add_argument(
        "--config", default="papers", metavar="FILE", help="papers (default), paper, smoke, or a YAML file"
    )
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
    train.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    arguments.add(train, "--workers", default=1, help="driving processes")
    train.add_argument("--threads", type=arguments.count, default=1, metavar="N", help="of the learner")
    recorded = train.add_argument_group("hpn", "learns from recordings (cosim record)")
    recorded.add_argument("--recordings", action="append", default=[], metavar="DIR", help="training seeds")
    recorded.add_argument("--validation", action="append", default=[], metavar="DIR", help="tuning seeds")
    recorded.add_argument("--variant", choices=VARIANTS, default="hpn", help="hpn is the one that ships")
    arguments.add(train, "--out", required=True)
    train.set_defaults(work=work)


def work(args: argparse.Namespace) -> int:
    """Train until the last iteration."""
    with extra("train", field="train", value=args.what):
        import tensorboard  # noqa: F401  # before anything is driven
    if args.what == "hpn":
        from cosim.learning import train_hpn

        train_hpn.check(args)
        return train_hpn.train(args)
    if args.what == "altruist":
        with extra("train", field="train", value=args.what):
            from cosim.learning import train_altruist

        return train_altruist.train(args)
    if args.what == "encoder":
        from cosim.learning import train_encoder

        return train_encoder.train(args)
    from cosim.learning.train_vfn import train

    return train(args)
