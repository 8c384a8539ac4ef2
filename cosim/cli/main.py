"""The command line: one sub-command per module of `cosim.cli`, and the exit codes."""

import argparse
import contextlib
import importlib
import re
import signal
import sys
import threading
import traceback
from collections.abc import Iterator, Sequence
from typing import NoReturn

from cosim import __version__
from cosim.cli import COMMANDS
from cosim.errors import BadInput, CosimError, hint, one_of

WITHOUT_FLAG = ("--scenario", "--world")  # flags that are a positional argument in commands of one scenario


class Parser(argparse.ArgumentParser):
    """Wrong arguments are a BadInput, like any other bad input."""

    def error(self, message: str) -> NoReturn:
        """Raises BadInput for a message of argparse."""
        about = re.fullmatch(r"argument (.+?): (?:(invalid choice): )?(?:'(.*?)' ?)?(.*)", message, re.DOTALL)
        if about is None:
            raise BadInput(message)
        field, choice, value, problem = about.groups()
        if choice:
            one_of(value, re.findall(r"'(.*?)'", problem), field)
        raise BadInput(problem, field=field, value=value)


def main(argv: Sequence[str] | None = None) -> int:
    """Exit codes: 0 finished, 1 a threshold failed, 2 bad input, 3 simulator failure, 4 internal failure,
    130 interrupted."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    options: list[str] = []
    if "--" in arguments:
        cut = arguments.index("--")
        arguments, options = arguments[:cut], arguments[cut + 1 :]
    try:
        args = _parsed(arguments)
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


def _parsed(arguments: list[str]) -> argparse.Namespace:
    """The parsed arguments. Raises BadInput with the nearest flag for unknown arguments."""
    top = parser(*arguments[:1])
    args, unknown = top.parse_known_args(arguments)
    if not unknown:
        return args
    word, command = unknown[0], _command(top, arguments[0])
    flag = word.partition("=")[0]
    if not flag.startswith("-"):
        raise BadInput(f"is one word too many for cosim {arguments[0]}", field="argument", value=word)
    if flag in WITHOUT_FLAG and any(action.dest == "what" for action in command._actions):
        raise BadInput(f"is given without a flag: cosim {arguments[0]} NAME", field=flag)
    known = [name for action in command._actions for name in action.option_strings]
    raise BadInput(f"cosim {arguments[0]} has no such flag{hint(flag, known)}", field=flag)


def _command(top: argparse.ArgumentParser, name: str) -> argparse.ArgumentParser:
    """The parser of one command."""
    found = [a.choices for a in top._actions if isinstance(a, argparse._SubParsersAction)]
    command: argparse.ArgumentParser = found[0][name]
    return command


@contextlib.contextmanager
def _terminable() -> Iterator[None]:
    """Handle SIGTERM (`docker stop`, a scheduler's limit) like Ctrl-C."""
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
    top = Parser(prog="cosim", description="Altruistic cooperative driving in mixed traffic on SUMO.")
    top.add_argument("--version", action="version", version=f"cosim {__version__}", help="cosim's version")
    commands = top.add_subparsers(required=True, metavar="COMMAND")
    for name in (command,) if command in COMMANDS else COMMANDS:
        importlib.import_module(f"cosim.cli.{name.replace('-', '_')}").add(commands)
    return top


if __name__ == "__main__":
    sys.exit(main())
