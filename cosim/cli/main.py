"""The command line: one sub-command per module of `cosim.cli`, and what every exit code means."""

import argparse
import contextlib
import importlib
import signal
import sys
import threading
import traceback
from collections.abc import Iterator, Sequence

from cosim import __version__
from cosim.cli import COMMANDS
from cosim.errors import BadInput, CosimError


def main(argv: Sequence[str] | None = None) -> int:
    """Exit codes: 0 finished, 1 a threshold failed, 2 bad input, 3 simulator failure, 4 our own failure,
    130 interrupted."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    options: list[str] = []
    if "--" in arguments:
        cut = arguments.index("--")
        arguments, options = arguments[:cut], arguments[cut + 1 :]
    try:
        args = parser(*arguments[:1]).parse_args(arguments)
        args.sumo_options = options
        if options and not getattr(args, "passes_on", False):
            problem = "only `cosim run` passes options on to SUMO; else they belong into the .sumocfg"
            raise BadInput(problem, field="--", value=" ".join(options))
        with _terminable():
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
    except Exception:
        traceback.print_exc()
        print("cosim: this is a fault of cosim's own: please report it with the lines above", file=sys.stderr)
        return CosimError.exit_code


@contextlib.contextmanager
def _terminable() -> Iterator[None]:
    """SIGTERM (`docker stop`, a scheduler's limit) ends the work in order, as Ctrl-C does."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def parser(command: str = "") -> argparse.ArgumentParser:
    """Every flag of one command, or of all."""
    top = argparse.ArgumentParser(
        prog="cosim", description="Altruistic cooperative driving in mixed traffic on SUMO."
    )
    top.add_argument("--version", action="version", version=f"cosim {__version__}", help="cosim's version")
    commands = top.add_subparsers(required=True, metavar="COMMAND")
    for name in (command,) if command in COMMANDS else COMMANDS:
        importlib.import_module(f"cosim.cli.{name.replace('-', '_')}").add(commands)
    return top


if __name__ == "__main__":
    sys.exit(main())
