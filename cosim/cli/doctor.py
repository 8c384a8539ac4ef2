"""`cosim doctor`: check this installation."""

from __future__ import annotations

import argparse

from cosim.cli import arguments


def add(verbs: arguments.Verbs) -> None:
    """Register the verb and its flags."""
    doctor = verbs.add_parser("doctor", help="check this installation and say how to mend it")
    doctor.add_argument("--json", action="store_true")
    doctor.set_defaults(work=work)


def work(args: argparse.Namespace) -> int:
    """Print every check."""
    from cosim.cli.doctor_work import doctor

    return doctor(args.json)
