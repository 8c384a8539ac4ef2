"""`cosim serve`: runs and sessions for many users over HTTP."""

import argparse
import sys

from cosim.cli import arguments
from cosim.errors import BadInput, extra


def add(commands: arguments.SubCommands) -> None:
    """Register the command and its flags."""
    serve = commands.add_parser(
        "serve",
        help="serve runs and sessions over HTTP",
        description="Serve runs and sessions over HTTP until it is ended (Ctrl-C, SIGTERM). What is queued "
        "or running then goes on after the next start with the same --data. Bound to another address "
        "than loopback it asks for a bearer token: the variable COSIM_TOKEN, or else what DIR/token "
        "holds, which is made at the first start. The variable COSIM_DATABASE_URL names a database where no "
        "flag does.",
    )
    texts = {
        "--host": ("HOST", "address to bind (default 127.0.0.1)"),
        "--data": ("DIR", "where runs and uploads are kept (default ./cosim-data)"),
        "--database": ("URL", "a database instead of DIR/service.sqlite"),
        "--database-file": ("FILE", "a file that holds its URL, which a command line shows to all"),
        "--ray-address": ("A", "an existing cluster (default: a local one)"),
    }
    arguments.texts(serve, texts)
    serve.add_argument(
        "--port", type=_port, default=8000, metavar="PORT", help="default 8000; 0: any free one"
    )
    arguments.add(serve, "--workers", help="processes of runs (default: all cores)")
    serve.add_argument("--engine", choices=("local", "ray"), default="local")
    serve.set_defaults(work=work, host="127.0.0.1", data="cosim-data")


def work(args: argparse.Namespace) -> int:
    """Serve until interrupted. Raises BadInput before listening."""
    with extra("service", field="serve"):
        from cosim.service.serving import serve
        from cosim.service.settings import database
    if args.engine == "local" and args.ray_address is not None:
        raise BadInput("goes with --engine ray", field="--ray-address", value=args.ray_address)
    given = {name: getattr(args, name) for name in ("host", "port", "workers", "engine", "ray_address")}
    url = database(args.database, args.database_file)
    return serve(args.data, said=sys.stderr, database=url, **given)


def _port(text: str) -> int:
    try:
        port = int(text)
    except ValueError:
        port = -1
    if not 0 <= port < 65536:
        raise argparse.ArgumentTypeError(f"{text!r} is not a port from 0 to 65535")
    return port
