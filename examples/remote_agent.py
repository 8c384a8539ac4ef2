"""The agent of own_agent.py with the simulation on a server; only the opening of the session differs.

cosim serve &
python examples/remote_agent.py [http://127.0.0.1:8000]
"""

import sys

from own_agent import drive

from cosim.service import client


def main(url: str) -> None:
    with client.open(url, "merge", demand="contested", svo=45) as session:
        drive(session)


if __name__ == "__main__":
    main(*(sys.argv[1:] or ["http://127.0.0.1:8000"]))
