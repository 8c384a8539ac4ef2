"""The command line: one sub-command per module of `cosim.app.verbs`, and what every exit code means."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from cosim.app.verbs import VERBS
from cosim.errors import CosimError


def main(argv: Sequence[str] | None = None) -> int:
    """Exit codes: 0 finished, 1 a threshold failed, 2 bad input, 3 simulator failure, 4 our own failure,
    130 interrupted."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    options: list[str] = []
    if "--" in arguments:
        cut = arguments.index("--")
        arguments, options = arguments[:cut], arguments[cut + 1 :]
    args = parser().parse_args(arguments)
    args.sumo_options = options
    try:
        return int(args.work(args))
    except CosimError as error:
        print(f"cosim: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("cosim: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # `cosim ... | head`
        sys.stderr.close()
        return 0


def parser() -> argparse.ArgumentParser:
    """Every verb and flag."""
    top = argparse.ArgumentParser(
        prog="cosim", description="Altruistic cooperative driving in mixed traffic on SUMO."
    )
    verbs = top.add_subparsers(required=True, metavar="VERB")
    for verb in VERBS:
        verb.add(verbs)
    return top


if __name__ == "__main__":
    sys.exit(main())
