"""`cosim fit-predictors`: fit the kinematic predictors on recorded episodes."""

import argparse

from cosim.cli import arguments


def add(commands: arguments.SubCommands) -> None:
    """Register the command and its flags."""
    command = commands.add_parser(
        "fit-predictors",
        help="fit the kinematic predictors on recorded episodes",
        description="Fit P's learned baselines and the Gaussian processes' prior over kernels on recordings "
        "(cosim record) of training seeds; calibrate and measure on recordings of validation seeds.",
    )
    needed = {
        "--training": ("DIR", "recordings, seeds below 100000"),
        "--validation": ("DIR", "recordings, seeds 100000..199999"),
    }
    arguments.texts(command, needed, required=True)
    command.add_argument(
        "--only", action="append", default=[], metavar="NAME", help="repeatable (default all)"
    )
    command.add_argument("--steps", type=arguments.count, metavar="N", help="gradient steps (6000)")
    arguments.add(command, "--out", required=True, help="for the weights and their cards")
    command.add_argument("--state", metavar="DIR", help="logs, and the state to continue an interrupted fit")
    command.set_defaults(work=work)


def work(args: argparse.Namespace) -> int:
    """Fit, and print the measured errors."""
    from pathlib import Path

    from cosim.errors import BadInput
    from cosim.learning.fit_predictors import FITTED, STEPS, fit_predictors

    for name in args.only:
        if name not in FITTED:
            problem = f"nothing to fit for this one (one of {', '.join(FITTED)})"
            raise BadInput(problem, field="--only", value=name)
    measured = fit_predictors(
        Path(args.training),
        Path(args.validation),
        Path(args.out),
        args.only or FITTED,
        args.steps or STEPS,
        None if args.state is None else Path(args.state),
    )
    for name, figures in measured.items():
        print(name, " ".join(f"{key.removeprefix('position_error_')}:{m:.3f}" for key, m in figures.items()))
    return 0
